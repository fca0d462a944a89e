"""How rows lie on the pages of a file: what a table takes on the disk is more than its text.

The rows of a table fill its pages in the order of their ids. One that does not fit the rest of a
page begins the next, and what is too long for a page lies on pages of its own (SQLite, Database
File Format, section 1.6: B-tree Pages).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

_PAGE_HEAD_BYTES: Final = 8
_CELL_HEAD_BYTES: Final = 7  # pointer, length and id
_LINK_BYTES: Final = 4  # to the next page of a long row
INDEX_BYTES: Final = 21  # an entry (run_id, sim_time_s, id) of a time index, measured


def disk_bytes(payloads: Iterable[int], page_bytes: int) -> float:
    """Bytes that rows which follow each other in a table take on the disk, without its indexes.

    Args:
        payloads: Bytes of the record of each row.
        page_bytes: Of the database.
    """
    room = page_bytes - _PAGE_HEAD_BYTES
    full_pages = own_bytes = filled = used = rows = 0
    for payload in payloads:
        local, own = _cell(payload, page_bytes)
        own_bytes += own
        if used + local > room:
            full_pages, filled, used, rows = full_pages + 1, filled + used, 0, 0
        used, rows = used + local, rows + 1
    if not rows:
        return 0.0
    # The last page goes on with other rows: it will be as full as the others.
    per_byte = page_bytes / (room - used / rows / 2)
    if full_pages:
        per_byte = full_pages * page_bytes / filled
    return full_pages * page_bytes + used * per_byte + own_bytes


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
