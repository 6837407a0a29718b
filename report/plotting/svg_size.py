"""Make an SVG of matplotlib smaller without changing what it shows."""

from __future__ import annotations

import re

from .svg_paths import short_number, shorter_path

# The layout uses the metrics of DejaVu Sans, which is wider than nearly every other font: labels
# fit with the reader's fonts.
_FONTS = "'DejaVu Sans', Verdana, system-ui, sans-serif"


_LINE = re.compile(r'<path d="([^"]*)"((?: clip-path="[^"]*")? style="fill:none;[^"]*")/>')


def smaller_svg(text: str) -> str:
    """Return an SVG with coordinates to 0.1 points, without what has no effect.

    Left out are metadata, comments, white space between elements, unused ids, groups without
    attributes, styles that repeat a definition's, and vertices that do not show. Grid lines of one
    panel are one path.
    """
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r">\s+<", "><", text)
    text = re.sub(r'\bd="([^"]*)"', lambda path: f'd="{shorter_path(path[1])}"', text)
    text = re.sub(r'\b(x|y|width|height)="(-?\d+\.\d{3,})"', _short_attribute, text)
    text = re.sub(r' transform="rotate\(-?0 [^"]*\)"', "", text)
    text = re.sub(r'style="([^"]*)"', lambda style: f'style="{_short_style(style[1])}"', text)
    text = _without_repeated_styles(text)
    text = _without_unused_ids(text)
    text = _merged_lines(_without_plain_groups(text))
    return text.replace("<svg ", f'<svg font-family="{_FONTS}" ', 1).rstrip() + "\n"


def _short_attribute(match: re.Match[str]) -> str:
    return f'{match[1]}="{short_number(match[2])}"'


def _short_style(style: str) -> str:
    """Return a style without the common font and without the caps of lines."""
    rules = [re.sub(r"\s*:\s*", ":", rule.strip()) for rule in style.split(";")]
    left_out = ("font-family:", "stroke-linecap:square", "stroke-linejoin:miter")
    return ";".join(rule for rule in rules if rule and not rule.startswith(left_out))


def _without_repeated_styles(text: str) -> str:
    """Remove styles of <use> elements that are those of the path that they refer to."""
    known = dict(re.findall(r'<path id="([^"]+)" d="[^"]*" style="([^"]*)"/>', text))

    def shorter(use: re.Match[str]) -> str:
        return f"{use[1]}/>" if known.get(use[2]) == use[3] else use[0]

    return re.sub(r'(<use xlink:href="#([^"]+)"[^>]*?) style="([^"]*)"/>', shorter, text)


def _without_unused_ids(text: str) -> str:
    used = set(re.findall(r'(?:href="#|url\(#)([^")]+)', text))
    return re.sub(r' id="([^"]*)"', lambda found: found[0] if found[1] in used else "", text)


def _without_plain_groups(text: str) -> str:
    """Remove <g> elements without attributes, not what they contain."""
    plain: list[bool] = []

    def kept(tag: re.Match[str]) -> str:
        if tag[0] == "</g>":
            return "" if plain.pop() else tag[0]
        if not tag[0].endswith("/>"):
            plain.append(tag[0] == "<g>")
        return "" if tag[0] == "<g>" else tag[0]

    return re.sub(r"<g(?: [^>]*)?>|</g>", kept, text)


def _merged_lines(text: str) -> str:
    """Join opaque lines of one style between which there are only tick marks and texts."""
    tokens = re.findall(r"(?s)<path [^>]*/>|<use [^>]*/>|<text .*?</text>|<[^>]*>|[^<]+", text)
    out: list[str] = []
    style, place = "", -1
    for token in tokens:
        line = _LINE.fullmatch(token)
        if line is not None and "opacity" not in token and "dasharray" not in token:
            if line[2] == style:
                out[place] = out[place].replace('<path d="', f'<path d="{line[1]}', 1)
                continue
            style, place = line[2], len(out)
        elif not token.startswith(("<use ", "<text ", "<defs", "</defs", "<path id=")):
            style = ""
        out.append(token)
    return "".join(out)
