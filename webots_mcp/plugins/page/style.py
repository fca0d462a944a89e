"""How a tab looks: a few rules, since each widget keeps its own."""

from __future__ import annotations

from typing import Any, Final

from bokeh.models import GlobalInlineStyleSheet, InlineStyleSheet

_FONT: Final = "font: 13px/1.4 system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif;"
_INK: Final = "#333333"

PAGE: Final = f"""
body {{ margin: 0; background: #F4F5F7; color: {_INK}; {_FONT} }}
"""
CARD: Final = ":host { background: white; border-radius: 6px; box-shadow: 0 1px 2px #00000018; }"
SCROLLING: Final = ":host { overflow: hidden auto; padding: 6px 10px; box-sizing: border-box; }"
STATUS: Final = f"""
:host {{ color: {_INK}; {_FONT} }}
h1 {{ font-size: 15px; margin: 0; white-space: nowrap; }}
h2 {{ font-size: 12px; margin: 6px 0 2px; color: #666666; font-weight: 600; }}
.pill {{ border-radius: 9px; padding: 1px 9px; font-weight: 600; background: #E4E6EA; }}
.running {{ background: #CBEBDD; color: #0B5C3C; }}
.problem {{ background: #FBD9CF; color: #8A2B0A; }}
.why {{ color: #666666; margin-left: 8px; }}
"""
LOG: Final = f"""
:host {{ color: {_INK}; {_FONT} }}
.log {{ display: flex; flex-direction: column-reverse; height: 124px; overflow-y: auto;
  font: 12px/1.5 ui-monospace, 'DejaVu Sans Mono', monospace; }}
.log p {{ margin: 0; white-space: pre-wrap; overflow-wrap: anywhere; }}
.log time {{ color: #888888; display: inline-block; min-width: 76px; }}
.log b {{ display: inline-block; min-width: 64px; font-weight: 400; color: #888888; }}
.warning {{ background: #FFF4D6; }}
.error {{ background: #FDE3DB; }}
"""
NOTES: Final = f":host {{ {_FONT} font-size: 12px; color: #777777; }} p {{ margin: 0 0 2px; }}"
PICTURE: Final = f"""
:host {{ {_FONT} font-size: 12px; color: #777777; }}
img {{ display: block; max-width: 100%; max-height: 190px; margin: 0 auto; border-radius: 4px; }}
p {{ margin: 4px 0 0; text-align: center; }}
"""


def sheet(*rules: str) -> list[Any]:
    """Style sheets of one widget."""
    return [InlineStyleSheet(css="\n".join(rules))]


def page_sheet() -> list[Any]:
    """What holds for the whole page."""
    return [GlobalInlineStyleSheet(css=PAGE)]
