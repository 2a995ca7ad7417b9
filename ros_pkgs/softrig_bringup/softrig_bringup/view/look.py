"""Look of the page, light and dark: colours of pictures, styles, the frame of the page."""

from __future__ import annotations

from typing import Any

# Okabe and Ito's colours, as in the printed pictures; on dark the blue is the lighter one of the two
COLOURS = {
    "light": ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b07d00", "#56b4e9", "#7f5539"),
    "dark": ("#56b4e9", "#ff8a3d", "#2fc79b", "#e39ac4", "#f0b429", "#7fd0ff", "#c79a78"),
}
INK = {"light": "#222222", "dark": "#e8e6e3"}
SOFT = {"light": "#5f6368", "dark": "#a0a4aa"}
LINES = {"light": "#dddddd", "dark": "#3a3d42"}
PAPER = {"light": "#ffffff", "dark": "#1b1d20"}
CHANGED = {"light": "#882255", "dark": "#ee88bb"}


def theme(name: str) -> dict[str, Any]:
    """Return Bokeh's attributes of a picture in ``light`` or ``dark``."""
    ink, soft, lines, paper = INK[name], SOFT[name], LINES[name], PAPER[name]
    text = {"text_color": ink}
    return {"attrs": {
        "Plot": {"background_fill_color": paper, "border_fill_color": paper, "outline_line_color": None},
        "Grid": {"grid_line_color": lines},
        "Axis": {"axis_label_text_color": ink, "major_label_text_color": soft, "axis_line_color": soft,
                 "major_tick_line_color": soft, "minor_tick_line_color": None, "axis_label_text_font_style": "normal",
                 "major_label_text_font_size": "11px", "axis_label_text_font_size": "12px"},
        "Title": {**text, "text_font_size": "13px", "text_font_style": "bold"},
        "Legend": {"label_text_color": ink, "label_text_font_size": "11px", "background_fill_alpha": 0.0,
                   "border_line_alpha": 0.0, "spacing": 8, "padding": 2, "glyph_height": 14},
    }}  # fmt: skip


VARIABLES = """
:root { color-scheme: light; --ink: #222222; --soft: #5f6368; --line: #dddddd; --paper: #ffffff; --field: #f4f5f6;
  --accent: #0072b2; --wrong: #b3261e; --good: #00694d; }
:root.dark { color-scheme: dark; --ink: #e8e6e3; --soft: #a0a4aa; --line: #3a3d42; --paper: #1b1d20; --field: #26292d;
  --accent: #56b4e9; --wrong: #ff8a80; --good: #5fd6ac; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 14px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", sans-serif; }
.page { box-sizing: border-box; display: grid; gap: 4px 20px; padding: 8px 16px; max-width: 2200px; height: 100vh;
  margin: 0 auto; grid-template: auto auto minmax(0, 1fr) / minmax(320px, 5fr) minmax(0, 8fr) minmax(300px, 4fr);
  grid-template-areas: "head head head" "drawing curves knobs" "tables curves knobs"; }
.head { grid-area: head; } .drawing { grid-area: drawing; } .curves { grid-area: curves; } .knobs { grid-area: knobs; }
.tables { grid-area: tables; } .stage { display: contents; } .more { display: none; }
.curves, .knobs, .tables { overflow: hidden auto; overscroll-behavior: contain; }
details { border-top: 1px solid var(--line); padding: 2px 0; }
summary { cursor: pointer; padding: 3px 0; font-weight: 600; }
summary small { color: var(--soft); font-weight: normal; }
#lost { display: none; position: fixed; inset: 0 0 auto 0; z-index: 9; padding: 8px 16px; background: var(--wrong);
  color: var(--paper); }
@media (max-width: 1250px) { .page {
  grid-template: auto auto minmax(0, 3fr) minmax(0, 2fr) / minmax(0, 3fr) minmax(290px, 2fr);
  grid-template-areas: "head head" "drawing knobs" "curves knobs" "curves tables"; } }
@media (max-width: 800px) {
  .page { display: block; height: auto; padding: 6px 8px; } .curves, .knobs, .tables { overflow: visible; }
  .stage { display: block; position: sticky; top: 0; z-index: 5; background: var(--paper); }
  .curves { display: grid; grid-auto-flow: column; grid-auto-columns: 100%; overflow: auto hidden;
    scroll-snap-type: x mandatory; } .curves > * { scroll-snap-align: start; }
  .more { display: block; color: var(--soft); font-size: 12px; border-bottom: 1px solid var(--line); } }
"""
# the name of a number beside it
BESIDE = ".bk-input-group { display: grid; grid-template-columns: minmax(0, 1fr) 110px; white-space: normal; }"
# styles within the widgets, each of which has a shadow DOM of its own
WIDGETS = """
:host { color: var(--ink); font: inherit; }
.bk-input, .bk-btn-default, .bk-btn-primary { background: var(--field); color: var(--ink); border-color: var(--line); }
select:not([multiple]).bk-input { background-image: none; appearance: auto; }
.noUi-target { background: var(--field); border-color: var(--line); box-shadow: none; }
.noUi-connect { background: var(--soft) !important; }
.noUi-handle { background: var(--paper) !important; border-color: var(--soft); box-shadow: none; }
.bk-input[disabled] { background: var(--paper); color: var(--soft); }
.bk-btn-default:hover { background: var(--line); color: var(--ink); }
.bk-btn-default.bk-active, .bk-btn-primary { background: var(--accent); color: var(--paper); }
.bk-btn-default[disabled] { background: var(--paper); color: var(--soft); border-color: var(--line); opacity: 1; }
.bk-btn-default.bk-active[disabled] { background: var(--soft); color: var(--paper); }
.bk-input-group label, .bk-slider-title, label { color: var(--ink); }
h2 { font-size: 14px; margin: 14px 0 4px; }
h1 { font-size: 18px; margin: 0; }
p { margin: 2px 0; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: 13px; }
td, th { padding: 1px 8px 1px 0; text-align: left; vertical-align: top; border-bottom: 1px solid var(--line);
  overflow-wrap: break-word; }
td.n, th.n { text-align: right; } td.n, th.n, td.u { white-space: nowrap; }
th { color: var(--soft); font-weight: normal; }
.soft { color: var(--soft); } .wrong { color: var(--wrong); } .good { color: var(--good); }
svg { width: 100%; height: auto; max-height: 46vh; }
.bk-description > .bk-icon { background-color: var(--soft); }
.over { font-weight: 600; }
@media (max-width: 800px) { svg { max-height: 24vh; } }
"""

RECONNECT = """document.getElementById('lost').style.display = 'block'
const server = () => fetch('static/js/bokeh.min.js', {method: 'HEAD', cache: 'no-store'})
const ask = setInterval(() => server().then(() => { clearInterval(ask); location.reload() }, () => 0), 1000)
"""

TEMPLATE = (
    """{% block preamble %}<meta name="viewport" content="width=device-width, initial-scale=1">
<style>"""
    + VARIABLES
    + """</style>
<script>
const dark = matchMedia('(prefers-color-scheme: dark)'), now = '{{ look }}'
document.documentElement.classList.toggle('dark', now === 'dark')
const go = asked => { const address = new URL(location.href), wanted = dark.matches ? 'dark' : 'light'
  if (wanted !== now && (asked || !address.searchParams.has('look'))) {
    address.searchParams.set('look', wanted); location.replace(address) } }
go(false); dark.addEventListener('change', () => go(true))
</script>{% endblock %}
{% block contents %}<div id="lost" role="alert">The page has lost its run: it comes back
by itself while that goes on.</div>
<div class="page">
<header class="head">{{ embed(roots.head) }}</header>
<div class="stage">{% if drawn %}<div class="drawing">{{ embed(roots.drawing) }}</div>{% endif %}
<main class="curves">{% for name in curves %}{{ embed(roots[name]) }}{% endfor %}</main>
{% if curves | length > 1 %}<div class="more">{{ curves | length }} pictures: move them sideways</div>{% endif %}</div>
<aside class="knobs">{% for name, title, what, open in groups %}
<details {{ "open" if open }}><summary>{{ title | e }} <small>{{ what | e }}</small></summary>
{{ embed(roots[name]) }}</details>
{% endfor %}</aside>
<section class="tables">{{ embed(roots.tables) }}</section>
</div>{% endblock %}
"""
)
