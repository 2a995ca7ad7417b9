"""Publication data that archives require, in the form of RO-Crate: authors, publisher, date and licence."""

from __future__ import annotations

import argparse
import re
from typing import NamedTuple

_ORCID = re.compile(r"\s*(?:https://orcid\.org/)?(\d{4}-\d{4}-\d{4}-\d{3}[\dX])$")


class Publication(NamedTuple):
    """Publication data that an archive requires.

    Attributes
    ----------
    day : str
        Date of publication, as in ISO 8601.
    authors : tuple of dict
        Entities of persons, see `person`.
    publisher, license : dict or None
        Entities, see `publisher` and `license_of`.
    """

    day: str
    authors: tuple[dict[str, str], ...] = ()
    publisher: dict[str, str] | None = None
    license: dict[str, str] | None = None


def person(text: str) -> dict[str, str]:
    """Read an author: a name, and an ORCID after it if there is one.

    Raises
    ------
    argparse.ArgumentTypeError
        No name, or an ORCID whose check digit (ISO 7064 MOD 11-2) does not belong to its digits.
    """
    match = _ORCID.search(text)
    name = " ".join((text[: match.start()] if match else text).strip(" ,<(").split())
    if not name:
        raise argparse.ArgumentTypeError(f'expected a name, as "Ann Example 0000-0002-1825-0097", got {text!r}')
    if not match:
        if digits := re.search(r"[\dX-]{10,}$", text):
            raise argparse.ArgumentTypeError(f"{digits[0]}: expected an ORCID as 0000-0002-1825-0097")
        return {"@id": _local("person", name), "@type": "Person", "name": name}
    total = 0
    for digit in match[1].replace("-", "")[:-1]:
        total = (total + int(digit)) * 2
    if (12 - total % 11) % 11 != (10 if match[1][-1] == "X" else int(match[1][-1])):
        raise argparse.ArgumentTypeError(f"{match[1]}: its last digit does not belong to the others; is it mistyped?")
    return {"@id": f"https://orcid.org/{match[1]}", "@type": "Person", "name": name}


def publisher(text: str) -> dict[str, str]:
    """Read the publisher: a name, optionally followed by a web address."""
    name, _, address = text.strip().rpartition(" ") if "://" in text else (text.strip(), "", "")
    if not name:
        raise argparse.ArgumentTypeError(f'expected a name, as "Zenodo https://zenodo.org", got {text!r}')
    return {"@id": address or _local("organization", name), "@type": "Organization", "name": name}


def license_of(text: str) -> dict[str, str]:
    """Read a licence: its SPDX identifier, written as the SPDX list has it, or its web address."""
    if re.match(r"https?://\S+$", text):
        return {"@id": text, "@type": "CreativeWork", "name": text}
    # Late import: it reads the list of licences, which takes 4 ms.
    from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression

    expected = "expected one identifier of spdx.org/licenses, as CC-BY-4.0, or a URL"
    try:
        if not re.fullmatch(r"[A-Za-z0-9.-]+", text):  # an expression such as MIT OR Apache-2.0 has no page there
            raise InvalidLicenseExpression
        text = canonicalize_license_expression(text)
    except InvalidLicenseExpression:
        raise argparse.ArgumentTypeError(f"{text!r}: {expected}") from None
    return {"@id": f"https://spdx.org/licenses/{text}", "@type": "CreativeWork", "name": text}


def _local(kind: str, name: str) -> str:
    from urllib.parse import quote  # late import: it takes 3 ms of every command's start

    return f"#{kind}-{quote(name)}"
