"""The verb `pack`: a run as one file, which `run --like FILE` repeats anywhere."""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import json
import os
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from glob import escape
from io import BytesIO
from os.path import isfile
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

from softrig_bags.write import retell
from softrig_core import Rig, Run, Scenario, ScenarioError, rig_of
from softrig_core.block.params import flatten
from softrig_core.board import SIMULATORS
from softrig_core.guard import naming, print_line
from softrig_core.judge import registry
from softrig_core.kit.file_format import json_object, json_of
from softrig_core.rig.code import fingerprints, is_ours
from softrig_core.scenario.yaml_file import write_yaml

from ..options import repeat
from ..options.identity import HALF, asked_half, recorded_half, strangers
from ..options.like import TAPE, Recalled, digests, from_outside, recall, repeated
from ..options.run_options import Again, scenario_of
from ..pack.cargo import GROUPS, brings, runs_code
from ..pack.crate import crate
from ..pack.packed import FILES, MOST, About, about, digest_of, opened, placeless
from ..pack.parts import ABOUT, BAG, CRATE, METRICS, PACKAGES, SCENARIO, STUDY, SUFFIX, is_pack
from ..pack.publication import Publication
from ..pack.signature import sign, signature_path, signed_by
from ..page.citations import FILE as REFERENCES
from ..report.looked import differing
from ..run.run import versions
from ..study.batch import Log
from ..study.definition import FILE, saved
from ..study.draw import count
from ..study.packed import ROWS, of_folder, rows_alone, standing_alone as standing_alone_study
from ..study.table import without_signals

#: Endings of files that are read together: COMTRADE, and C with its headers.
TOGETHER = ({".cfg", ".dat", ".hdr", ".inf"}, {".c", ".h", ".cc", ".cpp", ".cxx", ".hh", ".hpp"})
_BUILT = {"__pycache__", "build", "install", "log", "dist", "runs", "node_modules"}  # folders without sources


class _Pack(NamedTuple):
    """Parts of a pack: files by place, its description, and whether nodes run C or boards."""

    files: Mapping[str, bytes | Path]
    about: About
    natives: bool = False

    @property
    def lacks(self) -> list[str]:
        """Return the packages whose sources are not in it."""
        return [name for name in self.about.packages if name not in self.about.offers]


def main(options: argparse.Namespace) -> int:
    """Write the file and print its contents; return the exit status."""
    verb = "study" if (options.run / "study.json").is_file() else "run"
    with TemporaryDirectory(prefix="softrig_pack_") as aside:
        if verb == "study":
            packed, rows = collect_study(options.run)
            contents = [f"{rows} row{'s' * (rows != 1)}"]
        else:
            packed = collect(options.run, Path(aside), bag=not options.no_bag)
            digests = f"digests of {len(packed.about.digests)} topics in place of its bag"
            contents = [packed.about.scenario, digests if options.no_bag else "its bag"]
        out = _written(packed, options, ".study" if verb == "study" else "")
    code = [f"package {name} {version}" for name, version in packed.about.packages.items() if name not in packed.lacks]
    print(f"wrote {out} ({out.stat().st_size / 1e3:.0f} kB): {', '.join([*contents, *code])}; elsewhere:")
    print(f"  scripts/softrig {verb} --like {out.name}{' --trust' if code or packed.natives else ''}")
    return _signed(packed, out, options)


def _written(packed: _Pack, options: argparse.Namespace, kind: str) -> Path:
    """Write the requested file, named after the scenario if no name is given."""
    out: Path = options.out or Path(packed.about.scenario + kind + SUFFIX)
    if out.is_dir():
        raise ScenarioError(f"--out {out}: is a folder, expected a file")
    publication = Publication(options.published, tuple(options.author), options.publisher, options.license)
    write(_described(packed, publication), out)
    return out


def _signed(packed: _Pack, out: Path, options: argparse.Namespace) -> int:
    """Sign the file if requested, and name the missing packages."""
    if options.sign is not None:
        sign(out, options.sign)
        print(f"wrote {signature_path(out)}: {signed_by(out)}")
    for name in packed.lacks:
        print_line(
            f"not in it: package {name}, whose sources are in no workspace here (--workspace DIR); a run needs it"
        )
    return 0


def collect_study(folder: Path) -> tuple[_Pack, int]:
    """Gather the files that repeat a study, and its rows; return also their number.

    Raises
    ------
    ScenarioError
        The folder has no study, the study has changed since or is not finished, or it uses packages outside softrig.
    """
    study = of_folder(folder)
    log = Log(folder / ROWS, count(study))
    rows = without_signals(log.rows())
    log.close()
    if len(rows) < count(study):
        raise ScenarioError(f"{folder}: {len(rows)} of {count(study)} rows are there; run the study to its end first")
    content = json_of((folder / "study.json").read_text())
    alone, scenarios = standing_alone_study(study)
    files: dict[str, bytes | Path] = {}
    for name, raw in scenarios.items():
        text, files_of = raw_alone(raw)
        files[f"{SCENARIO}/{name}.yaml"] = text
        files |= {f"{SCENARIO}/{target}": path for target, path in files_of.items()}
    files |= {f"{STUDY}/{FILE}": saved(alone).encode(), f"{STUDY}/{ROWS}": rows_alone(rows)}
    table = [folder / name for name in ("statistics.csv", "summaries.json") if (folder / name).is_file()]
    files |= {f"{STUDY}/{path.name}": path for path in table}
    packages, sources = _packages(content["code"])
    message = About(scenario=alone.scenario, versions=versions(), code=content["code"], **packages)
    return _Pack(files | sources, message), len(rows)


def collect(run: Path, aside: Path, *, bag: bool = True) -> _Pack:
    """Gather the files that repeat a run.

    Parameters
    ----------
    run : Path
        Its folder, its bag, or a pack of it.
    aside : Path
        An empty folder for a copy of the bag without folder names of this machine.
    bag : bool
        Whether to include the bag; otherwise digests of the messages on each topic are stored.

    Raises
    ------
    ScenarioError
        There is no run, its inputs have changed since, or only its bag has what is needed and the bag is to be left
        out.
    """
    if is_pack(run) and (names := brings(unpacked := opened(run), about(unpacked))):
        raise ScenarioError(
            f"{run}: it brings {', '.join(names)}, which packing would execute; send the original file instead"
        )
    before = recall(run, Again().parse_args)
    content = json_object((before.bag.parent if before.bag.is_file() else before.bag).parent / METRICS)
    scenario = scenario_of(before.options)
    scenario = scenario.having(nodes={name: entry for name, entry in scenario.nodes.items() if name != TAPE})
    rig = rig_of(scenario)
    _unchanged(run, rig, content)
    _one_run(run, rig, content, before)
    classes = [m.block_class for m in rig.members]
    measures = {e.function or name for name, e in scenario.figures.items()} & {*registry.registered()}
    code = fingerprints(classes, (registry.find(name).__module__ for name in sorted(measures)))
    was = before.made_with.get("code", code)
    for name in sorted(name for name in code if was.get(name, code[name]) != code[name]):
        print_line(
            f"the code of {name} is no longer that of the run ({was[name]} then, {code[name]} now): it may not repeat"
        )
    packages, sources = _packages(code)
    message = About(
        scenario=scenario.name,
        **packages,
        run=str(content.get("run", "")),
        versions=before.made_with.get("versions", {}),
        code=was,
        contents=before.made_with.get("contents", {}),
        digests={} if bag else _digests(before, scenario, content),
    )
    files: dict[str, bytes | Path] = {}
    if not bag:
        scenario = repeated(scenario, before)
    text, files_of = standing_alone(scenario)
    files[f"{SCENARIO}/{scenario.name}.yaml"] = text
    files |= {f"{SCENARIO}/{bag_path}": path for bag_path, path in files_of.items()}
    if citations := content.get("citations"):
        files[f"{SCENARIO}/{REFERENCES}"] = "\n\n".join(c["bibtex"] for c in citations).encode()
    command = {"command": f"softrig run --like {scenario.name}{SUFFIX}"}
    if content:
        files[METRICS] = (json.dumps(_elsewhere(content, command), indent=1) + "\n").encode()
    if bag:
        bag_path = _retold(before, aside, command) or before.bag
        bag_files = [bag_path] if bag_path.is_file() else sorted(f for f in bag_path.iterdir() if f.is_file())
        files |= {f"{BAG}/{file.name}": file for file in bag_files}
    return _Pack(files | sources, message, runs_code(scenario))


def _packages(code: Iterable[str]) -> tuple[dict[str, Any], dict[str, bytes | Path]]:
    """Return the entries of `About` for the packages outside softrig, and the files of these packages."""
    foreign = [name for name in code if not is_ours(name)]
    sources = {name: _sources(name) for name in foreign}
    files: dict[str, bytes | Path] = {}
    for name, folder in sources.items():
        files |= {f"{PACKAGES}/{name}/{file.relative_to(folder)}": file for file in _files(folder)} if folder else {}
    messages = {
        "packages": {name: _version(name) for name in foreign},
        "offers": {name: _offers(name) for name in foreign if sources[name]},
    }
    return messages, files


def _elsewhere(content: Mapping[str, Any], command: Mapping[str, str]) -> dict[str, Any]:
    """Return the metadata of a run for readers on other machines: without folders of this machine."""
    reported: dict[str, Any] = placeless({**content, **command})
    if "from" in reported:
        reported["from"] |= command
    return reported


def _retold(before: Recalled, aside: Path, command: Mapping[str, str]) -> Path | None:
    """Write the bag of a run without paths of this machine; None if the bag names none."""
    messages = {
        key: json_of(text) if key in ("from", "branched") else text for key, text in before.bag_metadata.items()
    }
    if "command" not in messages:
        return None
    entries = {k: v if isinstance(v, str) else json.dumps(v) for k, v in _elsewhere(messages, command).items()}
    retell(before.bag, aside / BAG, entries)
    return aside / BAG


def _described(packed: _Pack, publication: Publication) -> _Pack:
    """Add the metadata that archives read."""
    message, files = packed.about, packed.files
    verb = "study" if f"{STUDY}/{FILE}" in files else "run"
    text = f"A {verb} of {message.scenario}: `softrig {verb} --like FILE` repeats it number for number."
    sums = {name: _sha256(content) for name, content in files.items()}
    described = crate(message.scenario, text, message.versions, files, sums, publication)
    return packed._replace(files={**files, CRATE: described})


def write(packed: _Pack, out: Path) -> None:
    """Write a file; the same run produces the same bytes.

    Raises
    ------
    ScenarioError
        It would be larger than the limit for unpacking.
    """
    listed = {name: _sha256(content) for name, content in packed.files.items()}
    about = packed.about.model_copy(update={"files": listed})
    files: dict[str, bytes | Path] = {ABOUT: about.model_dump_json(indent=1).encode() + b"\n", **packed.files}
    size = sum(len(c) if isinstance(c, bytes) else c.stat().st_size for c in files.values())
    if len(files) > FILES or size > MOST:
        raise ScenarioError(
            f"{len(files)} files of {size} bytes in all, expected at most {FILES} of {MOST}; "
            "--no-bag leaves the bag out"
        )
    partial = out.with_name(f".{out.name}.{os.getpid()}.part")
    try:
        with naming(out), zipfile.ZipFile(partial, "w") as archive:
            for name, content in files.items():
                # With a date of 1980, because dates of files would make packs of the same run differ.
                entry = zipfile.ZipInfo(name)
                entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
                source = BytesIO(content) if isinstance(content, bytes) else content.open("rb")
                with source, archive.open(entry, "w", force_zip64=True) as into:
                    copyfileobj(source, into)
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)


def _sha256(content: bytes | Path) -> str:
    return digest_of(content) if isinstance(content, Path) else hashlib.sha256(content).hexdigest()


def _one_run(run: Path, rig: Rig, content: Mapping[str, Any], before: Recalled) -> None:
    """Refuse files of different runs: the figures of one beside the bag or the scenario of another."""
    recording = before.recording if before.recording.topics else None
    wrong = strangers(content, before.bag_metadata, recorded_half(recording) if recording is not None else "")
    digest = str(content.get("run") or before.bag_metadata.get("run", ""))
    if digest and not wrong and asked_half(rig, int(content.get("seed", rig.scenario.seed))) != digest[HALF:]:
        wrong = ["its scenario gives another duration, seed or parameters than the run had"]
    if "metrics" in content and recording is not None and not wrong:
        measured = Run(rig, rig.scenario.seed, recording, epoch=before.epoch).results
        wrong = differing(content["metrics"], measured)
    if wrong:
        raise ScenarioError(f"{run}: {wrong[0]}; run it again")


def _offers(package: str) -> dict[str, dict[str, str]]:
    """List the entry points of a package by group."""
    result: dict[str, dict[str, str]] = {}
    for point in importlib.metadata.distribution(package).entry_points:
        if point.group in GROUPS:
            result.setdefault(point.group, {})[point.name] = point.value
    return result


def _unchanged(run: Path, rig: Rig, content: Mapping[str, Any]) -> None:
    """Refuse a run whose scenario, parameter file or package has changed since."""
    recorded = content.get("parameters", {})
    for member in rig.members:
        now = json.loads(json.dumps(flatten(member.params)))
        for name, value in now.items() if member.name in recorded and not member.external else ():
            if recorded[member.name].get(name, value) != value:
                raise ScenarioError(
                    f"{run}: it ran with {member.name}.{name} = {recorded[member.name][name]!r}, which is "
                    f"{value!r} by now: run it again"
                )


def _digests(before: Recalled, scenario: Scenario, content: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the digests that replace a bag; refuse a run that scenario and changes alone do not reproduce."""
    if before.digests:
        return before.digests
    rig = rig_of(scenario.having(changes=[]))
    why = [
        "in real time" if before.epoch else "",
        "there were messages from outside" if from_outside(rig, before.recording) else "",
        "it ended early" if content.get("stopped") or content.get("error") else "",
    ]
    if any(why):
        raise ScenarioError(f"--no-bag: the run cannot be repeated without its bag ({', '.join(filter(None, why))})")
    return digests(Run(rig, scenario.seed, before.recording))


def standing_alone(scenario: Scenario) -> tuple[bytes, Mapping[str, Path]]:
    """Write a scenario that needs only the files that its nodes name, which are stored beside it by content.

    Returns
    -------
    bytes
        The text of its file.
    dict of str to Path
        Relative place to file.
    """
    return raw_alone(scenario.model_dump(mode="json", exclude_defaults=True, exclude={"name"}))


def raw_alone(content: Mapping[str, Any]) -> tuple[bytes, Mapping[str, Path]]:
    """Write the content of a scenario file, see `standing_alone`."""
    results: dict[str, Path] = {}

    def placed(files: Sequence[Path]) -> str:
        """Return the place of the first of some files that stay together."""
        folder = hashlib.sha256(files[0].read_bytes()).hexdigest()[:12]
        results.update({f"{folder}/{file.name}": file for file in files})
        return f"{folder}/{files[0].name}"

    def linked(link: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return a link to files in the pack: the description of the firmware, and the program of a simulator."""
        firmware, (kind, colon, name) = Path(link["firmware"]), link["port"].partition(":")
        described = next(iter(sorted(firmware.glob("*.json"))), firmware) if firmware.is_dir() else firmware
        result = {**link, "firmware": placed([described])} if described.is_file() else dict(link)
        if kind in SIMULATORS and isfile(name):
            program = Path(name)
            machine = [file for file in [program.with_suffix(".json")] if file.is_file()]
            result["port"] = f"{kind}{colon}{placed([program, *machine])}"
        return result

    def with_files(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {k: linked(v) if k == "link" and "firmware" in v else with_files(v) for k, v in value.items()}
        if isinstance(value, list):
            return [with_files(v) for v in value]
        if not isinstance(value, str) or not Path(value).suffix or not isfile(value):
            return value
        path = Path(value)
        return placed([path, *(file for file in _belongs(path) if file != path)])

    content = {**content, **{key: with_files(content[key]) for key in ("shared", "nodes") if key in content}}
    return write_yaml(content).encode(), results


def _belongs(path: Path) -> Iterator[Path]:
    """Yield a file and those of the same stem that its format reads beside it; no other file of its folder is
    packed.
    """
    suffixes: set[str] = next((suffixes for suffixes in TOGETHER if path.suffix.lower() in suffixes), set())
    beside = path.parent.glob(f"{escape(path.stem)}.*")
    yield from (file for file in beside if file == path or file.suffix.lower() in suffixes)


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def _sources(package: str) -> Path | None:
    """Find the folder of a package's sources: in its workspace, or from where pip has installed it."""
    folders: list[Path] = []
    if (workspace := repeat.workspace(package)) is not None:
        folders += [workspace]
    try:
        content = json.loads(importlib.metadata.distribution(package).read_text("direct_url.json") or "{}")
        url = urlsplit(str(content.get("url", "")))
        folders += [Path(unquote(url.path))] if url.scheme == "file" else []
    except (importlib.metadata.PackageNotFoundError, ValueError):
        pass
    for folder in folders:
        for manifest in (folder / "package.xml", *folder.glob("*/package.xml"), *folder.glob("src/**/package.xml")):
            if manifest.is_file() and _named(manifest) == package and manifest.with_name(package).is_dir():
                return manifest.parent
    return None


def _named(manifest: Path) -> str:
    try:
        return (ElementTree.parse(manifest).findtext("name") or "").strip()
    except (ElementTree.ParseError, OSError):
        return ""


def _files(folder: Path) -> Iterator[Path]:
    """Yield the files of a package: no hidden or generated files, no links to outside."""
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or path.name in _BUILT or path.suffix in (".pyc", ".egg-info"):
            continue
        if path.is_dir() and not path.is_symlink():
            yield from _files(path)
        elif path.is_file() and path.resolve().is_relative_to(folder.resolve()):
            yield path
