"""Lettering of picture sheets: text and mathematical symbols, set with OpenCV's own typeface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2

from cable_rpc.types import Image

Colour = tuple[int, int, int]

REGULAR, BOLD = 400, 700
HERSHEY = cv2.FONT_HERSHEY_DUPLEX
HERSHEY_PX = 30.0
"""Text height in pixels of the Hershey letters at scale 1."""


@dataclass(frozen=True, slots=True)
class Symbol:
    """A letter of the paper with its marks, e.g. M with a hat and the index k-1."""

    letter: str
    index: str = ""
    exponent: str = ""
    accent: str = ""
    """``^`` or ``~`` above the letter."""


@cache
def typeface(italic: bool = False) -> Any:
    """OpenCV's built-in TrueType face; None before OpenCV 5, which has only Hershey's stroke letters."""
    face = getattr(cv2, "FontFace", None)
    return None if face is None else face("italic" if italic else "sans")


def put_text(
    canvas: Image,
    text: str,
    origin: tuple[int, int],
    size: int,
    colour: Colour,
    weight: int = REGULAR,
    *,
    italic: bool = False,
) -> int:
    """Write one line, in place.

    Args:
        canvas: uint8 [H, W, 3] BGR.
        text: what to write.
        origin: (x of the first letter, y of the baseline).
        size: height of the type in pixels.
        colour: BGR.
        weight: 400 is regular, 700 bold.
        italic: slanted letters.

    Returns:
        x where the text ends.
    """
    face = typeface(italic)
    if face is None:
        scale, stroke = hershey_style(size, weight)
        cv2.putText(canvas, hershey_letters(text), origin, HERSHEY, scale, colour, stroke, cv2.LINE_AA)
    else:
        cv2.putText(canvas, text, origin, colour, face, size, weight)
    return origin[0] + text_width(text, size, weight, italic=italic)


def text_width(text: str, size: int, weight: int = REGULAR, *, italic: bool = False) -> int:
    """Width of a line in pixels; takes what `put_text` takes."""
    face = typeface(italic)
    if face is None:
        scale, stroke = hershey_style(size, weight)
        return cv2.getTextSize(hershey_letters(text), HERSHEY, scale, stroke)[0][0]
    # The box of the text leaves blanks at its ends out.
    blanks = len(text) - len(text.strip())
    left, _, width, _ = cv2.getTextSize((0, 0), text, (0, 0), face, size, weight)
    return left + width + round(0.25 * size * blanks)


def hershey_style(size: int, weight: int) -> tuple[float, int]:
    """(scale, stroke) of the Hershey letters that come near to a size and weight of type."""
    return size / HERSHEY_PX, 2 if weight >= BOLD and size >= 20 else 1


def hershey_letters(text: str) -> str:
    """The text in the letters that Hershey has, which are those of ASCII."""
    return text.translate({0x2212: "-", 0x2013: "-", 0xB7: ",", 0xD7: "x"}).encode("ascii", "replace").decode()


def fit_text(text: str, room: int, size: int, weight: int = REGULAR) -> str:
    """The text, cut with an ellipsis where it is wider than ``room`` pixels."""
    if text_width(text, size, weight) <= room:
        return text
    kept = len(text)
    while kept > 0 and text_width(text[:kept] + "...", size, weight) > room:
        kept -= 1
    return text[:kept].rstrip() + "..."


def put_symbol(canvas: Image, symbol: Symbol, origin: tuple[int, int], size: int, colour: Colour) -> int:
    """Write a symbol, in place; like `put_text`.

    Returns:
        x where the symbol ends.
    """
    x, baseline = origin
    end = put_text(canvas, symbol.letter, origin, size, colour, italic=True)
    if symbol.accent:
        accent_size = round(0.9 * size)
        left = x + (end - x - text_width(symbol.accent, accent_size)) // 2 + round(0.12 * size)
        # A tilde stands lower in its line than a hat.
        rise = round((0.52 if symbol.accent == "~" else 0.24) * size)
        put_text(canvas, symbol.accent, (left, baseline - rise), accent_size, colour)
    small = round(0.68 * size)
    ends = [end]
    if symbol.exponent:
        ends.append(put_text(canvas, symbol.exponent, (end + 1, baseline - round(0.4 * size)), small, colour))
    if symbol.index:
        index = (end + 1, baseline + round(0.22 * size))
        ends.append(put_text(canvas, symbol.index, index, small, colour, italic=True))
    return max(ends)
