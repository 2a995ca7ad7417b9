"""How the page looks, in light and in dark: colours of pictures, styles, the frame of the page."""

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
    """Give Bokeh's attributes of a picture in ``light`` or ``dark``."""
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
                   "border_line_alpha": 0.0, "spacing": 0, "padding": 2, "glyph_height": 14},
    }}  # fmt: skip


VARIABLES = """
:root { color-scheme: light; --ink: #222222; --soft: #5f6368; --line: #dddddd; --paper: #ffffff; --field: #f4f5f6;
  --accent: #0072b2; --wrong: #b3261e; --good: #00694d; }
:root.dark { color-scheme: dark; --ink: #e8e6e3; --soft: #a0a4aa; --line: #3a3d42; --paper: #1b1d20; --field: #26292d;
  --accent: #56b4e9; --wrong: #ff8a80; --good: #5fd6ac; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 14px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", sans-serif; }
.page { display: grid; grid-template-columns: minmax(0, 1fr) minmax(300px, 380px); gap: 8px 20px; padding: 10px 16px;
  max-width: 1900px; margin: 0 auto; }
.head { grid-column: 1 / -1; }
@media (max-width: 900px) { .page { grid-template-columns: minmax(0, 1fr); padding: 8px; } }
"""
# within the widgets, each of which is a world of its own
WIDGETS = """
:host { color: var(--ink); font: inherit; }
.bk-input, .bk-btn-default, .bk-btn-primary { background: var(--field); color: var(--ink); border-color: var(--line); }
.bk-btn-default:hover { background: var(--line); color: var(--ink); }
.bk-btn-default.bk-active, .bk-btn-primary { background: var(--accent); color: var(--paper); }
.bk-input-group label, .bk-slider-title, label { color: var(--ink); }
h2 { font-size: 14px; margin: 14px 0 4px; }
h1 { font-size: 18px; margin: 0; }
p { margin: 2px 0; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: 13px; }
td, th { padding: 1px 8px 1px 0; text-align: left; vertical-align: top; border-bottom: 1px solid var(--line);
  overflow-wrap: anywhere; }
td.n, th.n { text-align: right; white-space: nowrap; }
th { color: var(--soft); font-weight: normal; }
.soft { color: var(--soft); } .wrong { color: var(--wrong); } .good { color: var(--good); }
svg { width: 100%; height: auto; max-height: 420px; }
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
{% block contents %}<div class="page">
<header class="head">{{ embed(roots.head) }}</header>
<main>{{ embed(roots.pictures) }}</main>
<aside>{{ embed(roots.side) }}</aside>
</div>{% endblock %}
"""
)
