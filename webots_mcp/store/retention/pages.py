"""How rows lie on the pages of a file: what a table takes on the disk is more than its text.

The rows of a table fill its pages in the order of their ids. One that does not fit the rest of a
page begins the next, and what is too long for a page lies on pages of its own (SQLite, Database
File Format, section 1.6: B-tree Pages).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

_PAGE_HEAD_BYTES: Final = 8
_CELL_HEAD_BYTES: Final = 7  # pointer, length and id
_LINK_BYTES: Final = 4  # to the next page of a long row
INDEX_BYTES: Final = 21  # an entry (run_id, sim_time_s, id) of a time index, measured


def disk_shares(payloads: Sequence[int], page_bytes: int) -> list[float]:
    """Bytes that each of some rows takes on the disk, with its share of what stays free.

    Args:
        payloads: Bytes of the records of rows that follow each other in the table.
        page_bytes: Of the database.
    """
    room = page_bytes - _PAGE_HEAD_BYTES
    cells = [_cell(payload, page_bytes) for payload in payloads]
    shares: list[float] = []
    page: list[tuple[int, int]] = []
    used = filled_pages = filled_bytes = 0
    for cell in cells:
        if page and used + cell[0] > room:
            shares += _of_page(page, page_bytes / used)
            filled_pages, filled_bytes = filled_pages + 1, filled_bytes + used
            page, used = [], 0
        page.append(cell)
        used += cell[0]
    if not page:
        return shares
    # The last page goes on with rows that were not read: it will be as full as the others.
    expected = filled_pages * page_bytes / filled_bytes if filled_pages else 0.0
    return shares + _of_page(page, expected or page_bytes / (room - used / len(page) / 2))


def _of_page(page: Sequence[tuple[int, int]], disk_per_byte: float) -> list[float]:
    return [local * disk_per_byte + overflow for local, overflow in page]


def _cell(payload: int, page_bytes: int) -> tuple[int, int]:
    """Bytes of a row on its table page, and bytes of the pages that it has for itself."""
    most, least = page_bytes - 35, (page_bytes - 12) * 32 // 255 - 23
    if payload <= most:
        return payload + _CELL_HEAD_BYTES, 0
    link_room = page_bytes - _LINK_BYTES
    local = least + (payload - least) % link_room
    local = local if local <= most else least
    pages = -(-(payload - local) // link_room)
    return local + _CELL_HEAD_BYTES + _LINK_BYTES, pages * page_bytes
