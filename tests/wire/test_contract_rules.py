"""The contract keeps buf's rules and breaks no client of the last release; and the check sees it where it does not."""

from __future__ import annotations

import importlib.util
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def check(repository: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("proto_check", repository / "proto" / "check.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def changed(repository: Path, tmp_path: Path) -> Callable[[str, str], Path]:
    """A copy of the released contract in which a pattern has been replaced once."""

    def change(pattern: str, replacement: str) -> Path:
        shutil.copytree(repository / "proto" / "released" / "cable", tmp_path / "cable")
        proto = tmp_path / "cable" / "v1" / "perception.proto"
        text, count = re.subn(pattern, replacement, proto.read_text(), count=1)
        assert count == 1, f"nothing in the contract matches {pattern}"
        proto.write_text(text)
        return tmp_path

    return change


def test_style(check: ModuleType) -> None:
    assert check.style_problems() == []


def test_nothing_breaks_clients_of_the_last_release(check: ModuleType) -> None:
    assert check.breaking_changes() == []


@pytest.mark.parametrize(
    ("pattern", "replacement", "said"),
    [
        (r"int64 capture_time_ns = 2;", "int64 capture_time_ns = 14;", 'field "2" with name "capture_time_ns"'),
        (r"bytes data = 4;\n  // True when", "string data = 4;\n  // True when", "changed type"),
        (r"repeated Detection detections = 3;", "Detection detections = 3;", "changed cardinality"),
        (r"bool keyframe = 5;", "bool intra = 5;", "changed"),
        (r"  // Present in a Hello to resume;.*\n  bytes resume_token = 5;\n", "", "deleted"),
        (r"REJECT_REASON_DEADLINE = 2;", "REJECT_REASON_TOO_LATE = 2;", "changed name"),
        (r"rpc SyncClock\(SyncClockRequest\)", "rpc SyncClocks(SyncClockRequest)", "SyncClock"),
    ],
    ids=["number", "type", "repeated", "name", "deleted", "enum value", "method"],
)
def test_a_breaking_change_is_seen(
    check: ModuleType, changed: Callable[[str, str], Path], pattern: str, replacement: str, said: str
) -> None:
    problems = check.breaking_changes(changed(pattern, replacement))
    assert problems
    assert any(said in problem for problem in problems), problems


def test_an_addition_is_not_a_break(check: ModuleType, changed: Callable[[str, str], Path]) -> None:
    new_field = r"  // Keep the session's state for longer.\n  bool keep_longer = 2;\n}"
    source = changed(r"(bool keep_session = 1;\n)\}", r"\1" + new_field)
    assert check.breaking_changes(source) == []
    assert check.style_problems(source) == []


@pytest.mark.parametrize(
    ("pattern", "replacement", "said"),
    [
        (r"REJECT_REASON_DEADLINE = 2;", "DEADLINE = 2;", "prefix"),
        (r"  // Largest VideoFrame.data accepted.\n", "", "comment"),
        (r"uint32 max_in_flight = 1;", "uint32 maxInFlight = 1;", "lower_snake_case"),
    ],
    ids=["prefix", "comment", "case"],
)
def test_bad_style_is_seen(
    check: ModuleType, changed: Callable[[str, str], Path], pattern: str, replacement: str, said: str
) -> None:
    assert any(said in problem for problem in check.style_problems(changed(pattern, replacement)))
