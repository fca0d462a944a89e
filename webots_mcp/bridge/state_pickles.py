"""Copies of published states of any plain shape, by `pickle`, for states whose keys keep changing.

A module of its own, since importing `pickle` would be a twentieth of the bridge's import time.
"""

from __future__ import annotations

import io
import pickle
from typing import Any

from webots_mcp.bridge.encoding import Encoded, encode
from webots_mcp.bridge.plain_values import NotPlainError, require_plain


def copy_or_encode(state: object) -> bytes | Encoded:
    """Return a copy for `encode_copy`, which makes the text that `encode` would, or that text.

    Copying costs less than encoding. Only dicts of plain values are copied.
    """
    if state.__class__ is not dict:
        return encode(state)
    file = io.BytesIO()
    try:
        require_plain(state)
        _Copier(file, pickle.HIGHEST_PROTOCOL).dump(state)
    except Exception:  # noqa: BLE001  (the user's objects may raise anything)
        return encode(state)
    return file.getvalue()


def encode_copy(copy: bytes) -> Encoded:
    """Encode a state as it was when it was copied."""
    return encode(pickle.loads(copy))


class _Copier(pickle.Pickler):
    """Copies dicts, lists, tuples, texts, numbers and None, but no subclasses of them.

    The check before does not see subclasses among keys and in long arrays, and copies of those
    could differ.
    """

    def reducer_override(self, obj: object) -> Any:
        """Refuse every other type."""
        raise NotPlainError
