"""The site: every page has its place, everything is in the reference, no link is broken."""

import json
import re
import shutil
import subprocess
import urllib.parse
import warnings
from html.parser import HTMLParser
from pathlib import Path

import pytest
from docs import collect, conf, gallery, outline, reference, style
from docs.__main__ import accessible, build
from softrig_bringup import cli
from softrig_core import ScenarioError
from softrig_core.judge.registry import registered
from softrig_core.wire.types import TYPES


def test_every_page_of_the_packages_has_a_place_and_links_to_pages_of_the_site(tmp_path):
    collect.collect(tmp_path)
    made = [p for p in tmp_path.rglob("*.*") if p.suffix in (".md", ".ipynb") and p.parent.name != "pictures"]
    written = {p.relative_to(tmp_path).with_suffix("").as_posix() for p in made}
    assert written == set(outline.places().values())
    for page in made:
        text = page.read_text()
        assert "<!--" not in text, page
        for target in re.findall(r"\]\(([^)\s#:]+)(?:#[^)\s]*)?\)", re.sub(r"```.*?```", "", text, flags=re.S)):
            assert target == "../index.md" or (page.parent / target).exists(), (page, target)


def test_a_broken_link_is_reported(tmp_path):
    page = outline.pages()["tick"]
    with pytest.raises(ValueError, match=r"tick.md: the link gone.md leads to no page"):
        collect.moved("[a](gone.md)\n", page, "explanations/tick", tmp_path)


def test_links_of_a_moved_page_are_adapted(tmp_path):
    page = outline.pages()["tick"]

    def moved(text):
        return collect.moved(text, page, "explanations/tick", tmp_path)

    assert moved("[b](bits.md#how-far) [c](../../softrig_bags/doc/bags.md) [d](#here) [e](https://a.b)") == (
        "[b](bits.md#how-far) [c](../how-to/bags.md) [d](#here) [e](https://a.b)"
    )
    assert moved("```\n[b](gone.md)\n```\n") == "```\n[b](gone.md)\n```\n"
    assert moved("<!-- numbers\n1: x\n-->\nText\n") == "Text\n"
    assert moved("## A\n#### B\n#### C\n## D\n### E\n") == "## A\n### B\n### C\n## D\n### E\n"
    assert moved("So:\n\n    scripts/softrig list  # all\n    scripts/softrig new a\n\n    x = 1\n\nText\n") == (
        "So:\n\n```bash\nscripts/softrig list  # all\nscripts/softrig new a\n\nx = 1\n```\n\nText\n"
    )
    long = f"scripts/softrig run a {'b' * 60}"
    assert moved(f"So:\n\n    {long}  # as far\n    scripts/softrig run a  # all\n\nText\n") == (
        f"So:\n\n```bash\n# as far\n{long}\n# all\nscripts/softrig run a\n```\n\nText\n"
    )
    assert moved("<details>\n<summary>Three &lt; <code>four</code></summary>\n\n| a |\n|---|\n\n</details>\n") == (
        ":::{dropdown} Three < `four`\n\n| a |\n|---|\n\n:::\n"
    )
    assert moved("where $`x_1 < 2`$ is, for 3 $ and 4 $\n") == "where {math}`x_1 < 2` is, for 3 $ and 4 $\n"


def test_the_gallery_has_a_card_with_an_existing_picture_for_every_system(tmp_path):
    collect.collect(tmp_path)
    gallery.write(tmp_path)
    text = (tmp_path / "gallery/index.md").read_text()
    assert re.findall(r"^:link: (\w+)$", text, re.M) == list(outline.GALLERY)
    pictures = re.findall(r"^:img-top: (\S+)$", text, re.M)
    # The build of the site draws these.
    assert pictures == [f"../pictures/{name}_drawing.svg" for name in outline.GALLERY]
    gallery.thumbnail("tcp_aqm", tmp_path)
    assert "prefers-color-scheme:dark" in (tmp_path / "pictures/tcp_aqm_drawing.svg").read_text()
    assert {p.stem for p in (tmp_path / "gallery").glob("*.md")} == {*outline.GALLERY, "index"}


def test_the_reference_is_complete():
    verbs = reference.verbs()
    names = {*cli.make_parser()._subparsers._group_actions[0].choices}
    assert {n.split()[0] for n in re.findall(r"^##+ (.+)$", verbs, re.M)} == names
    heads = re.findall(r"^#+ (.+)$", verbs, re.M)
    assert len(heads) == len(set(heads))
    assert "| `--subject-to 'FIGURE <= X'` |" in verbs
    assert "HIGH\\*N" in verbs
    for option in ("--mode", "--junit FILE", "--rel", "--rate"):
        assert re.search(rf"^\| `[^`]*{option}\b", verbs, re.M), option
    assert re.findall(r"^## (\w+)$", reference.figures(), re.M) == registered()
    assert all(f"`{name.replace('/msg/', '/')}`" in reference.messages() for name in TYPES)
    nodes = reference.all_nodes()
    assert "[`dc_motor_plant`](nodes/drives_dc_motor_plant.md)" in nodes["nodes"]
    assert all(f"]({place}.md)" in nodes["nodes"] for place in nodes.keys() - {"nodes"})
    assert "| `current_a`" not in (page := nodes["nodes/drives_dc_motor_plant"])
    assert re.search(r"^\| `Kt` \| [\d.]+ \| N m/A \|", page, re.M)
    doors = "".join(reference.front_door().values())
    for home, names in reference.softrig_core._HOMES.items():
        assert home == "former" or all(f":: softrig_core.{name}\n" in doors for name in names.split())
    pages = reference.api("softrig_optim")
    assert ":: softrig_optim.search." in pages["softrig_optim/search"]
    assert all(f"]({place}.md)" in pages["softrig_optim"] for place in pages.keys() - {"softrig_optim"})


class _Links(HTMLParser):
    def __init__(self):
        super().__init__()
        self.targets, self.loaded, self.names = [], [], set()

    def handle_starttag(self, tag, attrs):
        results = dict(attrs)
        self.names.add(results.get("id"))
        if tag in ("script", "img", "link", "iframe"):
            self.loaded += [u for u in (results.get("src"), results.get("href")) if u]
        elif results.get("href"):
            self.targets.append(results["href"])


def links(page):
    parser = _Links()
    parser.feed(page.read_text())
    return parser


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_the_site_is_built_without_a_warning_and_needs_no_network(tmp_path):
    assert build(tmp_path) == 0
    html = tmp_path / "html"
    results = {page.resolve(): links(page) for page in html.rglob("*.html")}
    assert len(results) > 50
    for page, own in results.items():
        for target in own.loaded:
            assert not re.match(r"(https?:)?//", target), (page, target)
        for target in (*own.targets, *own.loaded):
            path, _, anchor = target.partition("#")
            path = path.partition("?")[0]
            if ":" in path:
                continue
            linked = (page.parent / urllib.parse.unquote(path)).resolve() if path else page
            assert linked.exists(), (page, target)
            if anchor and linked in results:
                assert urllib.parse.unquote(anchor) in results[linked].names, (page, target)
    words = Path(html / "searchindex.js").read_text()
    assert "lockstep" in words

    assert not re.search(r"<th[^>]*>(\s|</?p>)*</th>", (html / "reference/verbs.html").read_text())
    assert '"latex"' in words  # "latex" occurs on no page, so the search must not have it
    violated = violations(html, tmp_path)
    assert not violated, violated


def violations(html, folder):
    """The violations that axe-core finds on every page in dark colours; none without a browser or npm."""
    chromium, driver, npm = map(shutil.which, ("chromium", "chromedriver", "npm"))
    got = npm and subprocess.run([npm, "install", "--prefix", folder, "axe-core@4"], capture_output=True, check=False)
    if not (chromium and driver and got) or got.returncode:
        return warnings.warn("accessibility not checked: no chromium, chromedriver or axe-core", stacklevel=2)
    from selenium import webdriver

    axe = (folder / "node_modules/axe-core/axe.min.js").read_text()
    options = webdriver.ChromeOptions()
    for option in ("--headless=new", "--no-sandbox", "--window-size=1400,1000", "--allow-file-access-from-files"):
        options.add_argument(option)
    options.binary_location = chromium
    result = []
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    try:
        browser.set_script_timeout(120)
        for page in sorted(html.rglob("*.html")):
            browser.get(page.as_uri())
            browser.execute_script(axe)
            for scheme, rules in (("light", []), ("dark", COLOURS)):
                wanted = [{"name": "prefers-color-scheme", "value": scheme}]
                browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": wanted})
                result += [(scheme, page.name, *violation) for violation in browser.execute_async_script(ASK, rules)]
    finally:
        browser.quit()
    return result


COLOURS = ["color-contrast", "link-in-text-block"]  # the other rules do not check colours
ASK = """
const [rules, done] = arguments;
const told = v => [v.id, v.nodes.length, v.nodes[0].html.slice(0, 160)];
axe.run(document, rules.length ? {runOnly: rules} : {}).then(r => done(r.violations.map(told)));
"""


def contrast(one, other):
    """Ratio of the luminances of two colours, as WCAG 2 defines it."""
    lights = []
    for colour in (one, other):
        parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.03928 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        lights.append(0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2] + 0.05)
    return max(lights) / min(lights)


@pytest.mark.parametrize("theme", [style.Light, style.Dark])
def test_every_colour_of_code_can_be_read(theme):
    assert contrast("#ffffff", "#000000") == pytest.approx(21.0)
    for token, about in theme:
        if about["color"]:
            assert contrast(f"#{about['color']}", theme.background_color) >= 4.5, token


def test_accessibility_faults_are_removed_from_a_page():
    page = '<th class="head"><p></p></th><th>a</th><div class="table-wrapper x"><aside class="sidebar-drawer">'
    assert accessible(page) == (
        '<td></td><th>a</th><div tabindex="0" class="table-wrapper x"><aside class="sidebar-drawer" aria-label="Pages">'
    )
    columns = '<div class="highlight-text notranslate"><div class="highlight"><pre>'
    assert accessible(columns) == f'{columns[:-1]} tabindex="0">'
    assert accessible('<span class="pre">a_b/c_1.d</span>a_b') == '<span class="pre">a_<wbr>b/<wbr>c_1.<wbr>d</span>a_b'


@pytest.mark.parametrize("name", sorted(outline.pages()))
def test_every_page_opens_with_a_sentence_that_lists_show(name):
    sentence = outline.opening(outline.pages()[name])
    assert 20 < len(sentence) < 330, sentence
    assert "```" not in sentence
    assert sentence[-1] in ".!?"


@pytest.mark.long
def test_a_notebook_whose_cell_fails_is_reported(tmp_path):
    from docs.notebooks import execute

    (tmp_path / "notebooks").mkdir()
    cell = {"cell_type": "code", "execution_count": None, "id": "a", "metadata": {}, "outputs": [], "source": "1 / 0"}
    text = json.dumps({"cells": [cell], "metadata": {}, "nbformat": 4, "nbformat_minor": 5})
    (tmp_path / "notebooks" / "bad.ipynb").write_text(text)
    with pytest.raises(ScenarioError, match=r"bad.ipynb: [\s\S]*ZeroDivisionError"):
        execute(tmp_path)


def test_an_index_is_a_script_for_names_with_a_dot():
    assert "<msub><mover" in re.sub(r"\s+(?=<)", "", conf.mathml(r"\dot x_k", as_block=True))
    assert "munderover" in conf.mathml(r"\sum_{k=1}^{n} x_k", as_block=True)
    assert "munderover" not in conf.mathml(r"\ddot q_r - \dot{\imath}_L + \hat\psi_s", as_block=False)


def test_every_formula_of_the_pages_can_be_typeset():
    """This finds daily what would break the build of the site."""
    pages = "".join(page.read_text() for page in collect.ROOT.glob("ros_pkgs/*/doc/**/*.md"))
    fences = re.findall(r"```math\n(.*?)```", pages, re.S)
    assert len(fences) >= 14  # at least one for each system
    for formula in fences:
        assert conf.mathml(formula, as_block=True).startswith("<math"), formula
