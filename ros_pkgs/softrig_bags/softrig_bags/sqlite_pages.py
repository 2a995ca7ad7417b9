"""Rows of a damaged SQLite file, read page by page without its tree (https://sqlite.org/fileformat2.html)."""

from __future__ import annotations

from collections.abc import Iterator

_TABLE_LEAF = 0x0D
_INTEGER_SIZES = {0: 0, 1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}


def message_rows(content: bytes) -> list[tuple[int, int, int, bytes]]:
    """Give (id, topic_id, timestamp, data) of every row that looks like one of rosbag2's ``messages`` table.

    Parameters
    ----------
    content : bytes
        The database file, cut anywhere.
    """
    page_size = int.from_bytes(content[16:18], "big")
    page_size = 65536 if page_size == 1 else page_size
    if page_size < 512:
        return []
    found: dict[int, tuple[int, int, int, bytes]] = {}
    used: set[int] = set()
    for start in range(page_size, len(content) - page_size + 1, page_size):
        if content[start] == _TABLE_LEAF:
            for row, payload in _cells(content, start, page_size, used):
                values = _message(payload)
                if values is not None:
                    found[row] = (row, *values)
    return [found[row] for row in sorted(found)]


def _cells(content: bytes, start: int, page_size: int, used: set[int]) -> Iterator[tuple[int, bytes]]:
    """Give (row number, record) of the cells of a leaf page; records cut off are left out.

    A page of overflow belongs to one record alone: `used` keeps damaged chains from being followed again and again.
    """
    count = int.from_bytes(content[start + 3 : start + 5], "big")
    for i in range(min(count, page_size // 4)):
        pointer = start + 8 + 2 * i
        at = start + int.from_bytes(content[pointer : pointer + 2], "big")
        size, at = _varint(content, at)
        row, at = _varint(content, at)
        if size > len(content):  # a damaged number
            continue
        largest, least = page_size - 35, (page_size - 12) * 32 // 255 - 23
        local = size
        if size > largest:
            local = least + (size - least) % (page_size - 4)
            local = local if local <= largest else least
        payload = bytearray(content[at : at + local])
        following = int.from_bytes(content[at + local : at + local + 4], "big") if size > local else 0
        while following and following not in used and len(payload) < size:
            used.add(following)
            page = content[(following - 1) * page_size : following * page_size]
            if len(page) <= 4:  # cut off
                break
            payload += page[4 : 4 + size - len(payload)]
            following = int.from_bytes(page[:4], "big")
        if len(payload) == size:
            yield row, bytes(payload)


def _message(payload: bytes) -> tuple[int, int, bytes] | None:
    """Take a record apart; None when it is not (NULL, integer, integer, blob)."""
    header, at = _varint(payload, 0)
    if header > len(payload):
        return None
    kinds = []
    while at < header:
        kind, at = _varint(payload, at)
        kinds.append(kind)
    if len(kinds) != 4 or kinds[0] != 0 or kinds[1] not in _INTEGER_SIZES or kinds[2] not in _INTEGER_SIZES:
        return None
    if kinds[3] < 12 or kinds[3] % 2:
        return None
    numbers = []
    for kind in kinds[1:3]:
        size = _INTEGER_SIZES[kind]
        numbers.append(int.from_bytes(payload[at : at + size], "big", signed=True) if size else int(kind == 9))
        at += size
    if len(payload) != at + (kinds[3] - 12) // 2:
        return None
    return numbers[0], numbers[1], payload[at:]


def _varint(content: bytes, at: int) -> tuple[int, int]:
    value = 0
    for i in range(9):
        byte = content[at + i] if at + i < len(content) else 0
        if i == 8:
            return value << 8 | byte, at + 9
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + i + 1
    raise AssertionError
