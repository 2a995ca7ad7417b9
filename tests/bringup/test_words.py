"""Words that pages, messages and docstrings avoid: the glossary of the language guide has a standard term for each."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCES = {
    str(path.relative_to(ROOT)): path.read_text()
    for room in ("ros_pkgs", "scripts")
    for path in sorted((ROOT / room).rglob("*.py"))
}
PAGES = [ROOT / "README.md", ROOT / ".github/CONTRIBUTING.md", *sorted((ROOT / "ros_pkgs").glob("*/doc/*.md"))]

# Words for persons used for things, outdated adverbs, and verbs of speech used for messages.
AVOIDED = re.compile(
    r"\b(anew|seldom|lest|whomever|wherefore|who (?:reads|says|sends)|(?:is|are) told|hands? (?:on|out)\b(?! of))\b",
    re.IGNORECASE,
)
# A docstring that begins with such a word does not state what its function does.
FIRST = re.compile(
    r'^ *(?:(?:async )?def [^\n]*|\)[^\n]*):\n +r?"{3}((?:Give|What|Whether|Have|Take|Say|Tell|Make)\b[^\n]*)',
    re.MULTILINE,
)
# locals, parameters and fields of such names do not say what they hold (expected, printed, received, local, ...)
VAGUE = (
    "found|said|told|came|come|looked|took|taken|spoken|spoke|heard|given|mine|ours|theirs|own|one|who|what|where|here|"
    "there|whole|gone|made|of"
)
NAMED = re.compile(rf"\b({VAGUE})\b(?:, [\w, ]+ = | = |: | := |(?:, \w+)* (in) )")
BEFORE = {
    None: re.compile(r"(?:^ {4,}|[(,] ?\*{0,2}|\blambda (?:\w+, )*)\Z", re.MULTILINE),
    "in": re.compile(r"\bfor (?:\w+, )*\Z"),
}
ALLOWED = {
    # Exempt: names of Python, keys of files and parameters of documented functions.
    "what": "environment environments linear_view steady expand session simulate new look",
    "where": "definition claims requirement_entry findings instance",
    "of": "definition",
    # Exempt: placeholders in generated code.
    "found": "cdr",
}
# Parts of names of functions, classes and fields; `tell` is the optimisers' standard name beside `ask`.
DEFINED = re.compile(
    r"^ *(?:async )?def (\w+)|^ *class (\w+)|\bself\.(\w+)(?:: [^=\n]+)? = |^    (\w+): ", re.MULTILINE
)
WORDS = "found said told came come look looks looked take taken took heard hear spoken spoke say says tell tells"
SPEECH = {w for word in [*WORDS.split(), "doubt", "doubts", "spoilt", "excused", "bring"] for w in (word, word.title())}
KEPT = {"tell"}
LITERAL = re.compile(r'"[^"\n]* [^"\n]*"')


def vague(source: str) -> list[str]:
    """Return the locals and parameters with a name that does not say what they hold."""
    return [m[1] for m in NAMED.finditer(source) if BEFORE[m[2]].search(source[max(0, m.start() - 30) : m.start()])]


def of_speech(source: str) -> list[str]:
    """Return the names of functions, classes and fields with a verb of speech or perception for what they do."""
    names = ["".join(parts) for parts in DEFINED.findall(source)]
    return [name for name in names if name not in KEPT and SPEECH & {*re.findall(r"[A-Z]?[a-z]+", name)}]


def prose(page: str) -> str:
    """Return a page without code and comments."""
    for pattern in (r"(?s)```.*?```", r"(?s)<!--.*?-->", r"`[^`\n]*`", r"(?m)^    .*$"):
        page = re.sub(pattern, "", page)
    return page


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_uses_standard_terms(page):
    assert AVOIDED.findall(prose(page.read_text())) == []


def test_messages_use_standard_terms():
    results = [
        (name, text) for name, source in SOURCES.items() for text in LITERAL.findall(source) if AVOIDED.search(text)
    ]
    assert results == []


def test_a_docstring_begins_with_what_its_function_does():
    results = [(name, text) for name, source in SOURCES.items() for text in FIRST.findall(source)]
    assert results == []


def test_locals_and_parameters_say_what_they_hold():
    packages = {
        name: source for name, source in SOURCES.items() if name.startswith("ros_pkgs") and "/test/" not in name
    }
    uses = {(Path(name).stem, word) for name, source in packages.items() for word in vague(source)}
    assert uses == {(name, word) for word, names in ALLOWED.items() for name in names.split()}


def test_functions_classes_and_fields_say_what_they_do_or_hold():
    names = [(name, word) for name, source in SOURCES.items() if "/test/" not in name for word in of_speech(source)]
    assert names == []


def test_the_words_are_found_in_prose_and_in_literals_only():
    assert AVOIDED.findall("It is told anew.") == ["is told", "anew"]
    assert prose("a\n```sh\nanew\n```\n`anew` b\n\n    anew\n").split() == ["a", "b"]
    assert FIRST.findall('def f(x) -> int:\n    """Give x."""\ndef g():\n    """Return x."""\n') == ['Give x."""']
    assert vague("told.x = 1\ndef f(found: int, x):\n    said, y = x\n    return said.told") == ["found", "said"]
    assert vague("[x for x, own in given] or (made := 1, one in own, (lambda here: 2), *there)") == [
        "own",
        "made",
        "here",
    ]
    text = "class ToldNow:\n    heard: int\ndef tell(x):\n    def take(x):\n"
    text += "    self._said: int = self.told\n    self.taken = 1\n"
    assert of_speech(text + "take(x)\nself.came == 2\n") == ["ToldNow", "heard", "take", "_said", "taken"]
