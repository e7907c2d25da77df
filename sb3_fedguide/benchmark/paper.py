"""The paper's results, for comparison."""

from __future__ import annotations

_COLUMNS = ("fedavg", "fedkl", "fedrl", "fedsvrpgm", "fedguide-a", "fedguide-p", "fedguide")

#: F of the paper by family and method, mean over its five seeds (its table of results, 10 or 4 epochs, 256-256 networks).
#: The preferences of ReacherHard and the tasks' rewards of MetaWorld10 (v3) are not the paper's, so that levels differ.
PAPER_F: dict[str, dict[str, float]] = {
    family: dict(zip(_COLUMNS, values, strict=True))
    for family, values in {
        "Reacher": (-19.4, -20.9, -13.4, -24.9, -16.1, -12.2, -12.3),
        "ReacherHard": (-2531, -4274, -90.2, -8339, -1995, 90.7, 86.5),
        "HopperHard": (216, 242, 699, 387, 398, 437, 510),
        "MetaWorld10": (631, 445, 767, 668, 829, 914, 939),
    }.items()
}
