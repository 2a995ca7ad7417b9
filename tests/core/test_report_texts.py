"""The texts that blocks report, word for word: after a change of a text, write one file again and read the
difference.
"""

import ast
from pathlib import Path

from expected_text import check_expected

PACKAGES = Path(__file__).parents[2] / "ros_pkgs"


def words(text):
    """A text as a person reads it, with inserted values as formulas in braces."""
    if isinstance(text, ast.JoinedStr):
        return ast.unparse(text)[2:-1]  # without the f and the quotes
    return text.value if isinstance(text, ast.Constant) else f"{{{ast.unparse(text)}}}"


def reports():
    """A line for each report of a block: its module, level, key and text."""
    for file in sorted(PACKAGES.glob("softrig_*/softrig_*/**/*.py")):
        if "self.report(" not in (source := file.read_text()):
            continue
        place = ".".join(file.relative_to(PACKAGES).with_suffix("").parts[1:])
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "self.report":
                level, key, text = node.args
                yield f"{place}: {ast.unparse(level).removeprefix('Level.')} {words(key)}: {words(text)}"


def test_texts_of_reports_are_as_expected():
    check_expected("reports", reports())
