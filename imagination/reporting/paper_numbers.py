"""Results of the paper on Matterport3D: its tables "IoU of the Global Map" and "Number of Correct Pixels"."""

from collections.abc import Mapping, Sequence

SOURCE = "Paper, on Matterport3D"
"""Heading of the paper's rows in tables."""

RESOLUTION = 0.02
"""Resolution of the paper's maps, metres per cell."""

_COLUMNS = [(width, category) for width in (3.0, 2.5, 2.0) for category in ("chair", "bed", "table")]

_IOU = {
    "seg_gt": (0.423, 0.512, 0.486, 0.465, 0.550, 0.506, 0.495, 0.628, 0.527),
    "seg_hrnet": (0.155, 0.379, 0.189, 0.183, 0.422, 0.194, 0.210, 0.483, 0.214),
    "imagination_seen": (0.152, 0.316, 0.195, 0.179, 0.371, 0.197, 0.220, 0.425, 0.207),
    "imagination": (0.197, 0.386, 0.202, 0.213, 0.406, 0.205, 0.248, 0.439, 0.206),
}

_CORRECT = {
    "seg_gt": (4420871, 2229781, 1880935, 5816061, 2717801, 2373934, 7169134, 4506825, 2648728),
    "seg_hrnet": (1582407, 1785445, 798123, 2221629, 2278674, 1048716, 2990796, 3824152, 1297157),
    "imagination_seen": (1606542, 1477507, 863654, 2256515, 1994317, 1103031, 3288038, 3294188, 1344699),
    "imagination": (2488550, 2248037, 1246088, 3347148, 2859842, 1617987, 4783688, 4539208, 1884798),
}

Numbers = dict[tuple[str, float, str], float]
"""Values by approach, cell width in metres and category."""


def _numbers(rows: Mapping[str, Sequence[float]]) -> Numbers:
    return {
        (name, *column): value
        for name, values in rows.items()
        for column, value in zip(_COLUMNS, values, strict=True)
    }


IOU: Numbers = _numbers(_IOU)
CORRECT_PIXELS: Numbers = _numbers(_CORRECT)
