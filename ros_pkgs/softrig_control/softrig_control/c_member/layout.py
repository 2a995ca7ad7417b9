"""Members of a header's structs, as the compiler lays them out: read from its debug information."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

from elftools.dwarf.die import DIE
from elftools.elf.elffile import ELFFile

LARGEST = 4096  # numbers of one struct
WORD = 4  # bytes of a union that are carried as one whole number, which a double holds exactly
CONSTANTS = ("k", "constants")  # members of the state that NODE_init alone writes, beside one of the type NODE_params
_REAL, _BOOL, _WHOLE = {4}, {2}, {5: True, 6: True, 7: False, 8: False, 16: False}  # DW_ATE_*: whether signed

Kind = Literal["real", "bool", "signed", "unsigned", "word"]


class LayoutError(ValueError):
    """A header contains something that a node cannot have."""


class Leaf(NamedTuple):
    """One number of a struct."""

    access: str
    """How C reaches it in its struct, as ``pid.integral`` or ``table[2]``."""

    kind: Kind
    """A word is part of a union of several members."""

    bytes: int

    @property
    def name(self) -> str:
        """Its name in a state."""
        return self.access.replace("[", "_").replace("]", "").replace(".", "_")

    @property
    def whole(self) -> bool:
        """Return whether it is a whole number."""
        return self.kind != "real"


class Struct(NamedTuple):
    """A struct and its numbers, without those that are constants."""

    leaves: tuple[Leaf, ...]
    constants: tuple[str, ...]
    """Members that hold constants."""


def structs(compiled: Path, prefix: str) -> dict[str, Struct]:
    """Read the structs of a node.

    Parameters
    ----------
    compiled : Path
        Object file with debug information of a source that includes the header.
    prefix : str
        Name of the node.

    Returns
    -------
    dict of str to Struct
        By role: ``state``, ``in``, ``out`` and ``params``; those that the header has.

    Raises
    ------
    LayoutError
        A struct has a member that is not a number, or too many numbers; the message names the member.
    """
    names = {prefix: "state", f"{prefix}_in": "in", f"{prefix}_out": "out", f"{prefix}_params": "params"}
    results: dict[str, DIE] = {}
    with compiled.open("rb") as file:
        for unit in ELFFile(file).get_dwarf_info().iter_CUs():
            for die in unit.get_top_DIE().iter_children():
                name = _name(die)
                typed = die.tag == "DW_TAG_typedef" or (
                    die.tag in ("DW_TAG_structure_type", "DW_TAG_class_type") and "DW_AT_byte_size" in die.attributes
                )
                if name in names and typed:
                    results.setdefault(names[name], die)
        return {role: _struct(die, f"{prefix}_params") for role, die in results.items()}


def _struct(die: DIE, params: str) -> Struct:
    struct = _stripped(die)
    if struct.tag not in ("DW_TAG_structure_type", "DW_TAG_class_type"):
        raise LayoutError(f"{_name(die)} is not a struct")
    leaves: list[Leaf] = []
    constants: list[str] = []
    for member in _members(struct):
        name = _name(member)
        if name in CONSTANTS or _name(_type(member)) == params:
            constants.append(name)
        else:
            leaves += _leaves(member, f"{_name(die)}.", name)
    if len(leaves) > LARGEST:
        raise LayoutError(f"{_name(die)} holds {len(leaves)} numbers, expected at most {LARGEST}")
    return Struct(tuple(leaves), tuple(constants))


def _leaves(member: DIE, context: str, access: str) -> Iterator[Leaf]:
    if "DW_AT_bit_size" in member.attributes or "DW_AT_data_bit_offset" in member.attributes:
        raise LayoutError(f"{context}{access} is a bit-field; expected a whole type such as uint8_t")
    yield from _of(_type(member), context, access)


def _of(die: DIE, context: str, access: str) -> Iterator[Leaf]:
    die = _stripped(die)
    size = die.attributes["DW_AT_byte_size"].value if "DW_AT_byte_size" in die.attributes else 0
    if die.tag == "DW_TAG_base_type":
        yield Leaf(access, _kind(die, size, f"{context}{access}"), size)
    elif die.tag == "DW_TAG_enumeration_type":
        yield Leaf(access, "signed", size)
    elif die.tag in ("DW_TAG_structure_type", "DW_TAG_class_type"):
        for member in _members(die):
            name = _name(member)
            # C reaches the members of an anonymous struct without a name in between.
            yield from _leaves(member, context, f"{access}.{name}" if name else access)
    elif die.tag == "DW_TAG_union_type":
        members = _members(die)
        if len(members) == 1:
            yield from _leaves(members[0], context, f"{access}.{_name(members[0])}")
        else:
            # Which member of a union is valid is not known here, so its bytes are carried as they are.
            yield from (Leaf(f"{access}[{k}]", "word", WORD) for k in range(-(-size // WORD)))
    elif die.tag == "DW_TAG_array_type":
        yield from _array(die, context, access)
    else:
        kind = (
            "a pointer" if die.tag == "DW_TAG_pointer_type" else str(die.tag).removeprefix("DW_TAG_").replace("_", " ")
        )
        raise LayoutError(
            f"{context}{access} is {kind}; a state, an input or an output holds numbers only (constants that NODE_init "
            f"makes may be pointers in a member {CONSTANTS[0]!r})"
        )


def _array(die: DIE, context: str, access: str) -> Iterator[Leaf]:
    counts = []
    for rank in die.iter_children():
        attributes = rank.attributes
        if "DW_AT_count" in attributes:
            counts.append(attributes["DW_AT_count"].value)
        elif "DW_AT_upper_bound" in attributes and isinstance(attributes["DW_AT_upper_bound"].value, int):
            counts.append(attributes["DW_AT_upper_bound"].value + 1)
        else:
            raise LayoutError(f"{context}{access} is an array without a fixed length")
    if _product(counts) > LARGEST:
        raise LayoutError(f"{context}{access} holds {_product(counts)} numbers, expected at most {LARGEST}")
    elements = [""]
    for count in counts:
        elements = [f"{element}[{k}]" for element in elements for k in range(count)]
    for element in elements:
        yield from _of(_type(die), context, f"{access}{element}")


def _product(counts: list[int]) -> int:
    result = 1
    for count in counts:
        result *= count
    return result


def _kind(die: DIE, size: int, context: str) -> Kind:
    encoding = die.attributes["DW_AT_encoding"].value
    if encoding in _REAL and size in (4, 8):
        return "real"
    if encoding in _BOOL:
        return "bool"
    if encoding in _WHOLE and size <= 8:
        return "signed" if _WHOLE[encoding] else "unsigned"
    raise LayoutError(f"{context} is {_name(die)}; expected float, double, bool or a whole number of at most 64 bits")


def _members(die: DIE) -> list[DIE]:
    """Return the members that have a place in an object; C++ lists static ones, too, which are declarations."""
    return [
        child
        for child in die.iter_children()
        if child.tag == "DW_TAG_member" and "DW_AT_external" not in child.attributes
    ]


def _stripped(die: DIE) -> DIE:
    while die.tag in ("DW_TAG_typedef", "DW_TAG_const_type", "DW_TAG_volatile_type", "DW_TAG_atomic_type"):
        die = _type(die)
    return die


def _type(die: DIE) -> DIE:
    if "DW_AT_type" not in die.attributes:
        raise LayoutError(f"{_name(die)} has no type")
    return die.get_DIE_from_attribute("DW_AT_type")


def _name(die: Any) -> str:
    return die.attributes["DW_AT_name"].value.decode() if "DW_AT_name" in die.attributes else ""
