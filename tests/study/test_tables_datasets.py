"""The five data sets of the paper through `tables` at once, each written by its own writer from the rendered world."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import pytest
from typer import Typer
from typer.testing import CliRunner

from cable_rpc.cli.tables import tables
from cable_rpc.data.cadc import write_cadc
from cable_rpc.data.coco import write_coco
from cable_rpc.data.kitti import write_kitti
from cable_rpc.data.nuscenes import write_nuscenes
from cable_rpc.data.rendered_drive import DriveFrame, RenderedDrive
from cable_rpc.data.synthetic import SyntheticConfig
from cable_rpc.data.waymo import write_waymo

pytest.importorskip("pyarrow", reason="needs pyarrow for Waymo's Parquet files, in the study extra")

FRAMES = 4


def drive(seed: int, width: int = 224) -> list[DriveFrame]:
    return list(RenderedDrive(SyntheticConfig(seed, width, 128, 10.0, FRAMES, mount_height_m=1.6)))


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Path]:
    """Scheme to a root with one sequence; KITTI has two, the first of which is damaged."""
    base = tmp_path_factory.mktemp("sets")
    town = drive(3)
    write_nuscenes(base / "nuscenes", {"scene-0061": town}, keyframe_every=2)
    write_waymo(base / "waymo", {"1005081002024129653_5313_150_5333_150": town})
    write_cadc(base / "cadc", {"2018_03_06/0001": town})
    write_coco(base / "wod_zb", {"panorama": drive(5, 448)})
    write_kitti(base / "kitti", {"0000": town, "0001": town})
    image = sorted((base / "kitti").rglob("0000/*.png"))[2]
    image.write_bytes(image.read_bytes()[:500])
    return {name: base / name for name in ("nuscenes", "waymo", "cadc", "wod_zb", "kitti")}


def test_all_five_at_once_with_damage_skipped(roots: Mapping[str, Path], tmp_path: Path) -> None:
    app = Typer()
    app.command()(tables)
    options = {"segmenter": "boxes", "strategies": "cable,full-frame", "workers": "1", "out": str(tmp_path)}
    arguments = [word for key, value in options.items() for word in (f"--{key}", value)]
    data = [word for scheme, root in roots.items() for word in ("--data", f"{scheme}:{root}")]
    done = CliRunner().invoke(app, [*arguments, *data, "--reproduce", "--skip-bad"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    with (tmp_path / "table1.csv").open(newline="", encoding="utf-8") as file:
        rows = {row["row"]: row for row in csv.DictReader(file)}
    names = ["nuScenes", "WOD-ZB", "Waymo", "KITTI", "CADC", "average"]
    assert list(rows) == [label for name in names for label in (name, f"{name} (paper)")]
    for name in names[:-1]:
        row = rows[name]
        assert int(float(row["sequences"])) == (2 if name == "KITTI" else 1)
        assert int(float(row["frames"])) == (2 * FRAMES - 1 if name == "KITTI" else FRAMES)
        assert 0 < float(row["coverage"]) < 1
        assert 0 < float(row["recognition_05"]) <= 1
        assert float(row["byte_saving_bitstream"]) < 1
    markdown = (tmp_path / "tables.md").read_text(encoding="utf-8")
    assert "nuScenes: 1 sequence, 4 frames, 2 annotated" in markdown
    assert "## Left out as damaged" in markdown
    assert "0000" in markdown.partition("## Left out as damaged")[2]
    # Without leave to skip, the damaged sequence fails with the file's name and the others stand.
    refused = CliRunner().invoke(app, [*arguments, "--data", f"kitti:{roots['kitti']}"], catch_exceptions=False)
    assert refused.exit_code == 1
    assert "2 of 4 cells failed" in refused.output
