"""Lines on a map whose longitudes wrap at 180 degrees."""

from __future__ import annotations

from collections.abc import Sequence


def split_at_antimeridian(line: Sequence[Sequence[float]]) -> list[list[list[float]]]:
    """
    Cut a line where it crosses the antimeridian, as section 3.1.9 of https://www.rfc-editor.org/rfc/rfc7946 asks for.

    :param line: Longitude, latitude and any further numbers of every vertex, longitudes from -180 to 180; two vertices whose
        longitudes are more than 180 degrees apart are joined the other way round
    :return: Its parts, of two or more vertices each; further numbers are interpolated at the cuts
    """
    parts = [[list(line[0])]]
    for vertex in line[1:]:
        last = parts[-1][-1]
        if abs(vertex[0] - last[0]) > 180.0:
            side = 180.0 if last[0] > 0 else -180.0
            span = vertex[0] + 2 * side - last[0]
            share = (side - last[0]) / span if span else 0.0
            cut = [a + share * (b - a) for a, b in zip(last[1:], vertex[1:], strict=True)]
            if share > 0:
                parts[-1].append([side, *cut])
            parts.append([[-side, *cut]])
            if list(vertex) == parts[-1][0]:
                continue
        parts[-1].append(list(vertex))
    whole = [part for part in parts if len(part) > 1]
    return whole or [[list(line[0]), list(line[-1])]]
