"""Where CADC keeps its files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cable_rpc.errors import ConfigurationError, SourceError

WEBSITE = "http://cadcd.uwaterloo.ca"
LABELLED_TREES = ("labeled", "processed")
"""Undistorted images of the annotated instants: the download's name, and the devkit's."""
RAW_TREE = "raw"
TREES = (*LABELLED_TREES, RAW_TREE)
CAMERA = "image_00"


@dataclass(frozen=True, slots=True)
class DrivePaths:
    """The files of one drive."""

    drive: Path
    """``ROOT/DATE/NNNN``."""
    tree: str

    @property
    def images(self) -> Path:
        """Folder of the front camera."""
        return self.camera_of(self.tree) / "data"

    @property
    def stamps(self) -> Path:
        """Capture times of the front camera."""
        return self.camera_of(self.tree) / "timestamps.txt"

    @property
    def novatel(self) -> Path:
        """Folder of the GNSS/INS record and its time stamps."""
        return self.drive / self.tree / "novatel"

    @property
    def annotations(self) -> Path:
        """Cuboids of all annotated instants."""
        return self.drive / "3d_ann.json"

    @property
    def calibration(self) -> Path:
        """Folder of the date's calibration."""
        return self.drive.parent / "calib"

    @property
    def distorted(self) -> bool:
        """Whether the images show the lens's distortion."""
        return self.tree == RAW_TREE

    def camera_of(self, tree: str) -> Path:
        """The front camera's folder in a tree."""
        return self.drive / tree / CAMERA


def find_drives(root: Path) -> dict[str, Path]:
    """Folders of drives by what can follow ``#``, ``DATE/NNNN``, in order.

    Args:
        root: the folder of the dates, or the one that holds it as ``cadcd``.

    Raises:
        SourceError: there is no drive with images.
    """
    for base in (root, root / "cadcd"):
        drives = sorted(folder for folder in base.glob("*/*") if trees_of(folder))
        if drives:
            return {f"{folder.parent.name}/{folder.name}": folder for folder in drives}
    raise SourceError(
        f"{root} is no CADC folder: no {root / 'DATE' / 'NNNN' / LABELLED_TREES[0] / CAMERA / 'data'} is there; "
        f"the data set is to be had at {WEBSITE}"
    )


def trees_of(drive: Path) -> list[str]:
    """The trees of images that a drive has, undistorted ones first."""
    return [tree for tree in TREES if (drive / tree / CAMERA / "data").is_dir()]


def drive_paths(drive: Path, tree: str | None) -> DrivePaths:
    """The files of a drive in the tree asked for, or the first that is there.

    Raises:
        ConfigurationError: there is no such tree.
    """
    trees = trees_of(drive)
    if tree is not None and tree not in trees:
        raise ConfigurationError(f"{drive} has no images in '{tree}'; use tree={' or tree='.join(trees)}")
    return DrivePaths(drive, tree or trees[0])
