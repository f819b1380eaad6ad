"""Where KITTI tracking keeps its files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cable_rpc.errors import SourceError

WEBSITE = "https://www.cvlibs.net/datasets/kitti/eval_tracking.php"
SPLITS = ("training", "testing")
IMAGE_FOLDER = "image_02"


@dataclass(frozen=True, slots=True)
class SequencePaths:
    """The files of one sequence; all but images and calibration may be missing."""

    sequence: str
    split: Path

    @property
    def images(self) -> Path:
        """Folder of the left colour camera's images, ``FFFFFF.png``."""
        return self.split / IMAGE_FOLDER / self.sequence

    @property
    def labels(self) -> Path:
        """Boxes of the whole sequence."""
        return self.split / "label_02" / f"{self.sequence}.txt"

    @property
    def calibration(self) -> Path:
        """Projection matrices and sensor poses."""
        return self.split / "calib" / f"{self.sequence}.txt"

    @property
    def oxts(self) -> Path:
        """GPS/IMU record, one line per frame."""
        return self.split / "oxts" / f"{self.sequence}.txt"

    @property
    def stamps(self) -> Path:
        """Capture times as raw KITTI has them; the tracking download comes without."""
        return self.images / "timestamps.txt"


def find_sequences(root: Path) -> dict[str, SequencePaths]:
    """Sequences by what can follow ``#``, in order.

    Args:
        root: the folder of ``training`` and ``testing``, or one of both. Where both are there, sequences of the
            latter are named ``testing/NNNN``.

    Raises:
        SourceError: neither is there.
    """
    splits = [root] if (root / IMAGE_FOLDER).is_dir() else [root / name for name in SPLITS]
    splits = [split for split in splits if (split / IMAGE_FOLDER).is_dir()]
    if not splits:
        raise SourceError(
            f"{root} is no KITTI tracking folder: neither {root / 'training' / IMAGE_FOLDER} nor {root / IMAGE_FOLDER} "
            f"is there; the data set is to be had at {WEBSITE}"
        )
    found: dict[str, SequencePaths] = {}
    for split in splits:
        for folder in sorted((split / IMAGE_FOLDER).iterdir()):
            if folder.is_dir():
                name = folder.name if split == splits[0] else f"{split.name}/{folder.name}"
                found[name] = SequencePaths(folder.name, split)
    return found
