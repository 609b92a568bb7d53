"""Where the light is stopped along lines of `box_filter`: exact intervals, in float64.

A face with the corners c_0, c_1, c_2 and a light l, all homogeneous points of the world (a light's
direction of travel, negated, with a fourth component of zero), span every other point: p = a_0 c_0
+ a_1 c_1 + a_2 c_2 + a_3 l, or a = [c_0 c_1 c_2 l]^-1 p. The face keeps the light from p where a_0,
a_1, a_2 >= 0, inside the cone, and a_3 < 0, beyond the face. As p / w is linear along a line on the
screen, so are all a / w: each face stops the light in one interval. This holds for parallel light
too. Conventions are those of `reference.lit`.
"""

from typing import NamedTuple

import numpy as np

ENTRIES_AT_ONCE = 2**17


class Runs(NamedTuple):
    """Stretches of lines on the screen in which one face is seen; arrays (N,)."""

    line: np.ndarray
    start: np.ndarray
    end: np.ndarray
    face: np.ndarray


class _Groups(NamedTuple):
    """Lines on faces, each once, sorted by face; arrays (G,) but for `first` and `count`, (R,).

    The lines on face number k of `receiver` (R,) are `count[k]`, from `first[k]` on.
    """

    receiver: np.ndarray
    first: np.ndarray
    count: np.ndarray
    line: np.ndarray


def apart(lights) -> tuple[list[dict], list[dict]]:
    """Return what shines everywhere, and the lights that cast shadows, less their ambient part."""
    casting = [light for light in lights if light.get("shadow")]
    everywhere = [
        {"type": "ambient", "ambient": light.get("ambient", 0.0)} if light.get("shadow") else light
        for light in lights
    ]
    return everywhere, [light | {"ambient": 0.0} for light in casting]


def source(light) -> np.ndarray:
    """The light as a homogeneous point (4,)."""
    if light["type"] == "directional":
        return np.append(-np.asarray(light["direction"], float), 0.0)
    return np.append(np.asarray(light["position"], float), 1.0)


def facing(light, corners, face, normals) -> np.ndarray:
    """Whether points on the faces (N,) of `corners` (F, 3, 3) are on the side of the light.

    That is the side to which the points' normals (N, 3) point.
    """
    first, second, third = np.moveaxis(corners, 1, 0)
    plane = np.cross(second - first, third - first)
    place = source(light)
    towards = np.sum(plane * (place[:3] - place[3] * first), axis=1)
    return towards[face] * np.sum(plane[face] * normals, axis=1) > 0


class Shadow:
    """What stops one light on its way to faces of a picture.

    Args:
        light: a dict as of `reference.render_phong`.
        corners: (F, 3, 3) of the faces in the world.
        weights: (F, 3, 3), their barycentrics over w by pixel coordinates (x, y, 1).
        y: heights of the lines.
    """

    def __init__(self, light, corners, weights, y):
        place = source(light)
        points = np.pad(corners, ((0, 0), (0, 0), (0, 1)), constant_values=1.0)
        frame = np.empty((len(corners), 4, 4))
        frame[:, :, :3], frame[:, :, 3] = np.swapaxes(points, 1, 2), place
        self.caster = np.flatnonzero(np.linalg.det(frame) != 0)
        inside = np.linalg.inv(frame[self.caster]) * np.array([1, 1, 1, -1])[:, None]
        # Faces that touch at a corner or lie in one plane are not in each other's shadow.
        size = np.abs(corners - corners.mean(axis=(0, 1))).max()
        away = np.linalg.norm(place[:3] - place[3] * corners[self.caster, 0], axis=1)
        inside[:, 3, 3] -= 1e-9 * size / away
        self.inside = inside.reshape(-1, 4)
        self.surface = np.swapaxes(points, 1, 2) @ weights  # world/w by pixel coordinates
        self.y = y

    def lit(self, runs) -> Runs:
        """Return those parts of runs, on no line the same face twice in one place, that are lit."""
        groups, group, box = self._groups(runs)
        stride = 2 * np.ceil(runs.end.max(initial=0.0)) + 2
        shade_start, shade_end = self._union(groups, box, stride)
        bounds = np.stack([shade_start, shade_end], axis=1).ravel()
        start, end = group * stride + runs.start, group * stride + runs.end
        before = np.searchsorted(bounds, start, "right")
        cuts = np.maximum(np.searchsorted(bounds, end, "left") - before, 0)
        owner, number = expand(cuts + 1)
        at = before[owner] + number  # bounds up to here: odd in the shade
        padded = np.pad(bounds, 1)
        base = group[owner] * stride
        start = np.where(number == 0, runs.start[owner], padded[at] - base)
        end = np.where(number == cuts[owner], runs.end[owner], padded[at + 1] - base)
        kept = (at % 2 == 0) & (start < end)
        owner = owner[kept]
        return Runs(runs.line[owner], start[kept], end[kept], runs.face[owner])

    def _groups(self, runs) -> tuple[_Groups, np.ndarray, np.ndarray]:
        """Also the group of each run, and where receivers are: (R, 4) of x and y, low and high."""
        key = runs.face * len(self.y) + runs.line
        unique, group = np.unique(key, return_inverse=True)
        face, line = np.divmod(unique, len(self.y))
        receiver, first, count = np.unique(face, return_index=True, return_counts=True)
        groups = _Groups(receiver, first, count, line)
        box = np.tile([np.inf, -np.inf], (len(receiver), 2))
        number = np.searchsorted(receiver, runs.face)
        y = self.y[runs.line]
        for column, pick, values in (
            (0, np.minimum, runs.start),
            (1, np.maximum, runs.end),
            (2, np.minimum, y),
            (3, np.maximum, y),
        ):
            pick.at(box[:, column], number, values)
        return groups, group, box

    def _union(self, groups, box, stride) -> tuple[np.ndarray, np.ndarray]:
        """Disjoint intervals in the shade, ascending, as keys: group * stride + x."""
        some = max(1, ENTRIES_AT_ONCE // max(len(self.caster), 1))
        found = [
            self._intervals(groups, box, range(start, min(start + some, len(box))), stride)
            for start in range(0, len(box), some)
        ]
        start, end = np.concatenate([np.zeros((2, 0)), *found], axis=1)
        order = np.argsort(start)
        start, end = start[order], np.maximum.accumulate(end[order])
        opens = np.append(True, start[1:] > end[:-1])[: len(start)]
        return start[opens], end[np.roll(opens, -1)]

    def _intervals(self, groups, box, numbers, stride) -> np.ndarray:
        """Keys (2, N) of the start and end of the shade of every face on some receivers."""
        receiver, box = groups.receiver[numbers], box[numbers]
        table = np.einsum("cp,rpd->rcd", self.inside, self.surface[receiver], optimize=True)
        table = table.reshape(len(receiver), -1, 4, 3)
        slope, level, constant = np.moveaxis(table, -1, 0)
        x_low, x_high, y_low, y_high = box.T[..., None, None]
        most = np.maximum(slope * x_low, slope * x_high) + constant
        most += np.maximum(level * y_low, level * y_high)
        possible = np.all(most > 0, axis=2) & (self.caster != receiver[:, None])
        number, caster = np.nonzero(possible)
        lines = groups.count[numbers][number]
        found = [np.zeros((2, 0))]
        load = np.cumsum(lines) // ENTRIES_AT_ONCE
        for pairs in np.split(np.arange(len(number)), np.flatnonzero(np.diff(load)) + 1):
            pair, offset = expand(lines[pairs])
            group = groups.first[numbers][number[pairs]][pair] + offset
            some = table[number[pairs], caster[pairs]]
            low, high = self._shaded(some, pair, self.y[groups.line[group]], box[number[pairs]])
            kept = np.flatnonzero(low < high)
            found.append(group[kept] * stride + np.stack([low[kept], high[kept]]))
        return np.concatenate(found, axis=1)

    @staticmethod
    def _shaded(table, pair, y, box) -> tuple[np.ndarray, np.ndarray]:
        """Where all four rows of `table` (P, 4, 3) are positive at heights y of the pairs (N,)."""
        low, high = box[pair, 0], box[pair, 1]
        for slope, level, constant in np.moveaxis(table, 0, -1):
            value = level[pair] * y + constant[pair]
            slope = slope[pair]
            root = -value / np.where(slope != 0, slope, 1.0)
            low = np.where(slope > 0, np.maximum(low, root), low)
            high = np.where(slope < 0, np.minimum(high, root), high)
            high = np.where((slope == 0) & (value < 0), low, high)
        return low, high


def expand(counts) -> tuple[np.ndarray, np.ndarray]:
    """Count to each of `counts`: the entry and the number within it."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
