"""The store of a sweep's cells, and what its keys tell apart."""

from __future__ import annotations

import json
import os
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import sweep_runner_for_tests as cheap
from cable_codecs import RegionTreatment

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.errors import ConfigurationError
from cable_rpc.study import digests
from cable_rpc.study.closed_loop.models import ModelChoice
from cable_rpc.study.digests import source_stamp
from cable_rpc.study.sweep import identity
from cable_rpc.study.sweep.cell import MeasuredCell, RatePoint, SweepCell
from cable_rpc.study.sweep.cell_settings import CellLabels, cell_from_settings
from cable_rpc.study.sweep.identity import cell_key, cell_keys
from cable_rpc.study.sweep.simulated_link import SimulatedLink
from cable_rpc.study.sweep.store import CellStore

BASE = cheap.a_cell(1, 28)
LINK = SimulatedLink("lte", trace_ms=tuple(range(1, 3000)))


def measured(cell: SweepCell = BASE) -> MeasuredCell:
    return cheap.measure(cell, Path())


def content(one: MeasuredCell | None) -> list[Any]:
    """Comparable; the arrays of a result are not."""
    assert one is not None
    result = None if one.result is None else one.result.to_json()
    return [one.cell, result, one.error, one.example, one.seconds_taken, one.key]


def test_what_was_kept_is_found_again(tmp_path: Path) -> None:
    """Also with a link whose trace is long enough to be compressed."""
    path = tmp_path / "deep" / "cells.sqlite"
    linked = replace(BASE, link=LINK, roi=RoiConfig.paper(), roi_label="paper")
    with CellStore(path) as store:
        store.keep("a", measured())
        store.keep("b", measured(linked))
        assert store.find("c") is None
    with CellStore(path) as store:
        assert content(store.find("a")) == content(replace(measured(), key="a"))
        assert content(store.find("b")) == content(replace(measured(linked), key="b"))
        assert store.keys() == {"a", "b"}
    assert [one.name for one in path.parent.iterdir()] == ["cells.sqlite"]
    with sqlite3.connect(path) as plain:
        (text,) = plain.execute("SELECT settings FROM cells WHERE key = 'a'").fetchone()
    assert json.loads(text)["rate"] == {"quality": 28, "bitrate_kbps": None}


def test_a_failure_is_kept_but_not_found_and_replaces_nothing(tmp_path: Path) -> None:
    failed = MeasuredCell(BASE, None, "no memory")
    with CellStore(tmp_path / "cells.sqlite") as store:
        store.keep("a", failed)
        assert store.find("a") is None
        assert store.read("a") == replace(failed, key="a")
        assert store.keys() == frozenset()
        store.keep("a", measured())
        store.keep("a", failed)
        assert content(store.find("a")) == content(replace(measured(), key="a"))


def test_settings_come_back_as_the_cell() -> None:
    clip = replace(BASE.clip, size=(320, 192), fps=5.0, models=ModelChoice("boxes", "onnx:model.onnx"))
    cell = replace(
        BASE, clip=clip, link=LINK, treatment=RegionTreatment(scale=0.5), rate=RatePoint(bitrate_kbps=300),
        roi=RoiConfig.paper(), roi_label="paper",
    )  # fmt: skip
    settings = json.loads(json.dumps(cell.settings()))
    assert cell_from_settings(settings, CellLabels.of(cell)) == cell


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE cells SET result = substr(result, 1, 40)",
        "UPDATE cells SET result = '{}'",
        "UPDATE cells SET result = x'789c0102'",
        "UPDATE cells SET settings = '[]'",
        "UPDATE cells SET labels = '[1'",
    ],
)
def test_a_damaged_row_is_missing_and_says_so(tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "cells.sqlite"
    with CellStore(path) as store:
        store.keep("a", measured())
    with sqlite3.connect(path) as plain:
        plain.execute(damage)
    with CellStore(path) as store:
        assert store.find("a") is None
    assert "damaged" in caplog.text


def test_another_schema_or_file_is_left_as_it_is(tmp_path: Path) -> None:
    newer, foreign, text = (tmp_path / name for name in ("newer", "foreign", "text"))
    CellStore(newer).close()
    with sqlite3.connect(newer) as plain:
        plain.execute("PRAGMA user_version = 7")
    with sqlite3.connect(foreign) as plain:
        plain.execute("CREATE TABLE invoices (id)")
    text.write_text("a,b\n" * 999)
    for path in (newer, foreign, text):
        before = path.read_bytes()
        with pytest.raises(ConfigurationError, match="--store"):
            CellStore(path)
        assert path.read_bytes() == before


def test_a_full_disk_is_told_and_loses_nothing(tmp_path: Path) -> None:
    """SQLite answers its own page limit as it answers a full disk."""
    path = tmp_path / "cells.sqlite"
    with CellStore(path) as store:
        store.keep("a", measured())
        (pages,) = store.connection.execute("PRAGMA page_count").fetchone()
        store.connection.execute(f"PRAGMA max_page_count = {pages}")
        with pytest.raises(ConfigurationError, match="full"):
            for number in range(100):
                store.keep(f"b{number}", measured())
        assert store.find("a") is not None
    with CellStore(path) as store:
        assert store.find("a") is not None


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="can't open the store"):
        CellStore(tmp_path / "file" / "cells.sqlite")


def test_the_log_of_a_killed_process_is_recovered(tmp_path: Path) -> None:
    path = tmp_path / "cells.sqlite"
    program = (
        "import os, pathlib, sweep_runner_for_tests as c; from cable_rpc.study.sweep.store import CellStore;"
        f"s = CellStore(pathlib.Path({str(path)!r})); s.keep('a', c.measure(c.a_cell(1, 28), pathlib.Path()));"
        "os.kill(os.getpid(), 9)"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    assert subprocess.run([sys.executable, "-c", program], env=environment, check=False).returncode == -9
    assert path.with_name("cells.sqlite-wal").stat().st_size > 0
    with CellStore(path) as store:
        assert content(store.find("a")) == content(replace(measured(), key="a"))


def test_everything_that_changes_a_figure_changes_the_key_and_no_label_does(monkeypatch: pytest.MonkeyPatch) -> None:
    changed = [
        replace(BASE, strategy="open-loop"),
        replace(BASE, codec="hevc"),
        replace(BASE, rate=RatePoint(29)),
        replace(BASE, rate=RatePoint(bitrate_kbps=300)),
        replace(BASE, treatment=RegionTreatment(fill="grey")),
        replace(BASE, treatment=RegionTreatment(scale=0.5)),
        replace(BASE, feedback_delay=2),
        replace(BASE, link=LINK),
        replace(BASE, link=replace(LINK, delay_ms=30.0)),
        replace(BASE, roi=RoiConfig.paper()),
        replace(BASE, block_size=16),
        *(replace(BASE, clip=replace(BASE.clip, **change)) for change in (
            {"source": "synthetic:2"}, {"fps": 5.0}, {"size": (160, 96)}, {"max_frames": 3}, {"truth": "detector"},
            {"prompt": "cars"}, {"models": ModelChoice(segmenter="boxes")},
        )),
    ]  # fmt: skip
    keys = cell_keys([BASE, *changed])
    assert len(set(keys)) == len(keys)
    assert [cell_key(cell) for cell in (BASE, *changed)] == keys
    labelled = replace(changed[7], treatment_label="x", roi_label="y", link=replace(LINK, name="z"))
    assert cell_key(labelled) == keys[8]
    monkeypatch.setattr(identity, "measuring_code", cheap.pinned_digest)
    assert cell_key(BASE) != keys[0]


def test_the_code_digest_follows_every_measuring_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for part in identity.MEASURING_PARTS:
        assert (Path(digests.__file__).parents[1] / part).exists()
    one, other = tmp_path / "one.py", tmp_path / "other.py"
    one.write_text("a = 1\n")
    other.write_text("b = 1\n")
    monkeypatch.setattr(digests, "measuring_sources", lambda parts: iter((one, other)))
    digest_now = digests.code_digest.__wrapped__
    before = digest_now(())
    assert digest_now(()) == before
    other.write_text("b = 2\n")
    assert digest_now(()) != before


def test_stamps_follow_the_files_of_a_source(tmp_path: Path) -> None:
    root = tmp_path / "set"
    for name in ("0001", "0002"):
        images = root / "training" / "image_02" / name
        images.mkdir(parents=True)
        (images / "000000.png").write_bytes(b"picture")
        (root / "training" / "label_02").mkdir(exist_ok=True)
        (root / "training" / "label_02" / f"{name}.txt").write_text("car")
    specs = [f"kitti:{root}#0001", f"kitti:{root}#0002?camera=2", f"video:{root}", f"video:{root}/training/x.mp4"]
    before = [source_stamp(spec) for spec in specs]
    assert before[3] == []
    assert source_stamp("synthetic:1?route=turns") == []
    (root / "training" / "image_02" / "0002" / "000000.png").write_bytes(b"another picture")
    after = [source_stamp(spec) for spec in specs]
    assert [one != two for one, two in zip(before, after, strict=True)] == [False, True, True, False]
    (root / "training" / "label_02" / "0001.txt").write_text("cars")
    assert source_stamp(specs[0]) != before[0]
