"""Rules of the house that a machine can check: style, types, dependency arrows."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

BARRED_ON_THE_EDGE = (
    "torch", "transformers", "onnxruntime", "onnx", "plotly", "jinja2", "skimage", "cable_models", "opentelemetry",
    "prometheus_client",
)  # fmt: skip


def run(repository: Path, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", *command], cwd=repository, capture_output=True, text=True, check=False)


def test_ruff_finds_nothing(repository: Path) -> None:
    checked = run(repository, "ruff", "check", ".")
    assert checked.returncode == 0, checked.stdout
    formatted = run(repository, "ruff", "format", "--check", ".")
    assert formatted.returncode == 0, formatted.stdout


@pytest.mark.timeout(300)
def test_mypy_finds_nothing(repository: Path) -> None:
    checked = run(repository, "mypy")
    assert checked.returncode == 0, checked.stdout


def test_edge_imports_with_the_base_dependencies_only() -> None:
    """A finder that refuses the heavy modules stands in for an environment without them."""
    program = f"""
import sys, pkgutil, importlib

class Barred:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {BARRED_ON_THE_EDGE!r}:
            raise ModuleNotFoundError(f"{{name}} is not installed on an edge box")

sys.meta_path.insert(0, Barred())
import cable_rpc.edge, cable_rpc.data, cable_rpc.wire, cable_codecs
for package in (cable_rpc.edge, cable_rpc.data, cable_rpc.wire, cable_codecs):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        importlib.import_module(module.name)
import cable_rpc.cli.stream, cable_rpc.study.stream_run
loaded = {{name.split(".")[0] for name in sys.modules}} & set({BARRED_ON_THE_EDGE!r})
sys.exit(f"loaded: {{loaded}}" if loaded else 0)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_base_dependencies_are_light(repository: Path) -> None:
    import tomllib

    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    names = {requirement.split(">")[0].split("[")[0] for requirement in project["dependencies"]}
    assert not names & set(BARRED_ON_THE_EDGE)
    assert set(project["optional-dependencies"]) >= {"cloud", "study", "trial", "ray", "dev", "all"}


def imported_packages(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return found


@pytest.mark.parametrize(
    ("folder", "forbidden"),
    [
        ("codecs/cable_codecs", ("cable_rpc", "cable_models")),
        ("models/cable_models", ("cable_rpc", "cable_codecs", "grpc")),
        ("cable_rpc/edge", ("cable_rpc.cloud", "cable_rpc.study", "cable_rpc.cli", "cable_models")),
        ("cable_rpc/wire", ("cable_rpc.cloud", "cable_rpc.edge", "cable_rpc.study", "cable_rpc.data")),
        ("cable_rpc/tracing", ("cable_rpc.cloud", "cable_rpc.edge", "cable_rpc.study", "cable_rpc.cli")),
        ("cable_rpc/data", ("cable_rpc.cloud", "cable_rpc.edge", "cable_rpc.study", "cable_rpc.wire")),
        ("cable_rpc/cloud", ("cable_rpc.edge", "cable_rpc.study", "cable_rpc.cli")),
    ],
)
def test_dependencies_point_one_way(repository: Path, folder: str, forbidden: tuple[str, ...]) -> None:
    wrong = [
        f"{path.relative_to(repository)} imports {name}"
        for path in (repository / folder).rglob("*.py")
        for name in imported_packages(path)
        if name.startswith(forbidden)
    ]
    assert not wrong
