#!/usr/bin/env bash
# rcl gives the parameters of a node to another place if a section before it in the file has a name of several parts.
#
# Versions: ros-jazzy-rclpy 7.1.6, ros-jazzy-rmw-fastrtps-cpp 8.4.3 (wheels of PyPI). Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: keys below a key are names below it, so law: below /left: is /left/law, whatever stands before it.
# Behaviour: at the end of a section rcl takes one part off its place, however many the key had. Behind cell/plant: the parameters of
# law: belong to /left/cell/law, and /left/law starts with its defaults, without a word. The same two sections in the other order are
# read as guessed. Write nested keys, or full names at the first level.
#
# Output seen:
seen=$(
    cat <<'SEEN'
plant, law: /left/plant 1, /left/law 2
cell/plant, law: /left/cell/plant 1, /left/cell/law 2
a/b/plant, law: /left/a/b/plant 1, /left/a/b/law 2
law, cell/plant: /left/law 2, /left/cell/plant 1
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check ros-jazzy-rclpy==7.1.6 ros-jazzy-rmw-fastrtps-cpp==8.4.3
now=$(
    venv/bin/python - <<'PROGRAM'
import rclpy
from rclpy.node import Node

PLANT, LAW = "  %s:\n    ros__parameters: {k: 1}\n", "  law:\n    ros__parameters: {k: 2}\n"
CASES = {
    "plant, law": PLANT % "plant" + LAW,
    "cell/plant, law": PLANT % "cell/plant" + LAW,
    "a/b/plant, law": PLANT % "a/b/plant" + LAW,
    "law, cell/plant": LAW + PLANT % "cell/plant",
}
PLACES = [(f"/left{space}", name) for space in ("", "/cell", "/a/b") for name in ("plant", "law")]
for title, sections in CASES.items():
    with open("p.yaml", "w") as file:
        file.write("/left:\n" + sections)
    values = []
    for space, name in PLACES:
        context = rclpy.Context()
        rclpy.init(context=context, args=["--ros-args", "--params-file", "p.yaml"])
        node = Node(name, namespace=space, context=context, automatically_declare_parameters_from_overrides=True,
                    enable_rosout=False, start_parameter_services=False)
        if node.has_parameter("k"):
            values.append(f"{node.get_fully_qualified_name()} {node.get_parameter('k').value}")
        node.destroy_node()
        rclpy.shutdown(context=context)
    print(f"{title}: {', '.join(values)}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
