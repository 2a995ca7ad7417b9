"""Colours of code on the site: every one has a contrast of 4.5 or more to its ground, light or dark."""

from __future__ import annotations

from pygments.style import Style
from pygments.token import Comment, Error, Generic, Keyword, Literal, Name, Number, Operator, String, Token


def _styles(text: str, comment: str, keyword: str, string: str, number: str, name: str) -> dict[object, str]:
    return {
        Token: text, Comment: f"italic {comment}", Keyword: keyword, Operator.Word: keyword, String: string,
        Number: number, Literal: number, Name.Function: name, Name.Class: name, Name.Decorator: name,
        Name.Tag: keyword, Name.Variable: number, Generic.Heading: f"bold {text}", Generic.Prompt: comment, Error: text,
    }  # fmt: skip


class Light(Style):  # type: ignore[misc]
    """On light ground."""

    background_color = "#f6f8fa"
    styles = _styles("#1f2328", "#57606a", "#0550ae", "#116329", "#953800", "#6639ba")


class Dark(Style):  # type: ignore[misc]
    """On dark ground."""

    background_color = "#1c1f24"
    styles = _styles("#e6edf3", "#a0a8b3", "#79c0ff", "#a5d6a7", "#ffb26b", "#d2a8ff")
