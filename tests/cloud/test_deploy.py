"""The files under deploy/ against the program that they deploy: metrics, flags, probes, units."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from configparser import ConfigParser
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from google.rpc import status_pb2
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from cable_rpc.cli.app import app
from cable_rpc.cloud.metrics import ServerMetrics
from cable_rpc.cloud.metrics_endpoint import MetricsEndpoint
from cable_rpc.wire.v1 import perception_pb2 as pb

LABELS_OF_PROMETHEUS = {"instance", "job"}
METRICS_OF_PROMETHEUS = {"up"}
UNITS = ("cable-rpc-serve.service", "cable-rpc-stream.service")


@pytest.fixture(scope="session")
def deploy(repository: Path) -> Path:
    return repository / "deploy"


@pytest.fixture(scope="module")
def exposed() -> dict[str, set[str]]:
    """Every sample that a scrape can have, and its labels."""
    metrics = ServerMetrics()
    metrics.batch_done("detect", 1, 1)
    metrics.response_sent(pb.StreamPerceptionResponse(closing=pb.Closing(status=status_pb2.Status(code=4))))
    samples: dict[str, set[str]] = {}
    for family in text_string_to_metric_families(generate_latest(metrics.registry).decode()):
        for sample in family.samples:
            samples.setdefault(sample.name, set()).update(sample.labels)
    return samples


def expressions_of(node: Any) -> Iterator[str]:
    if isinstance(node, dict):
        for key, value in node.items():
            if key == "expr":
                yield value
            else:
                yield from expressions_of(value)
    elif isinstance(node, list):
        for value in node:
            yield from expressions_of(value)


def check_expression(text: str, exposed: dict[str, set[str]]) -> None:
    for name, matchers in re.findall(r"\b(cable_\w+|up)\b(?:\{([^}]*)\})?", re.sub(r"by \([^)]*\)", "", text)):
        if name in METRICS_OF_PROMETHEUS:
            continue
        assert name in exposed, text
        for label in re.findall(r"(\w+)\s*[=!]~?", matchers):
            assert label in exposed[name] | LABELS_OF_PROMETHEUS, text
    for grouping, grouped in re.findall(r"by \(([^)]*)\) \((?:\w+\()?(cable_\w+)", text):
        for label in grouping.split(", "):
            assert label in exposed[grouped] | LABELS_OF_PROMETHEUS, text
    if "histogram_quantile" in text:
        assert re.search(r"by \([^)]*\ble\b[^)]*\)", text), text
    for name in re.findall(r"\b(cable_\w+_(?:total|bucket|sum|count))\b", text):
        assert re.search(rf"(rate|increase)\({name}", text), f"a counter by itself says nothing: {text}"
    assert text.count("(") == text.count(")")
    assert text.count("{") == text.count("}")


def test_the_dashboard_asks_for_what_there_is(deploy: Path, exposed: dict[str, set[str]]) -> None:
    dashboard = json.loads((deploy / "grafana" / "cable-rpc.json").read_text())
    expressions = list(expressions_of(dashboard))
    assert len(expressions) > 15
    for expression in expressions:
        check_expression(expression, exposed)
    shown = {name for text in expressions for name in re.findall(r"cable_\w+", text)}
    base = {re.sub(r"_(total|bucket|sum|count|created)$", "", name) for name in exposed}
    assert {re.sub(r"_(total|bucket|sum|count)$", "", name) for name in shown} == base - {"cable_frames_received"}
    (query,) = [entry["definition"] for entry in dashboard["templating"]["list"] if "definition" in entry]
    assert query == "label_values(cable_build_info, instance)"


def test_the_documents_list_every_metric(repository: Path, exposed: dict[str, set[str]]) -> None:
    rows = [
        line.split("|") for line in (repository / "docs" / "operations.md").read_text().splitlines()
        if line.startswith("| `cable_")
    ]  # fmt: skip
    listed = {re.findall(r"\w+", cells[1])[0]: set(re.findall(r"`(\w+)`", cells[3])) for cells in rows}
    base = {re.sub(r"_(bucket|sum|count)$", "", name): labels - {"le"} for name, labels in exposed.items()}
    assert listed == {name: labels for name, labels in base.items() if not name.endswith("_created")}


def test_panels_do_not_overlap(deploy: Path) -> None:
    panels = json.loads((deploy / "grafana" / "cable-rpc.json").read_text())["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    taken: set[tuple[int, int]] = set()
    for panel in panels:
        place = panel["gridPos"]
        cells = {(place["x"] + i, place["y"] + j) for i in range(place["w"]) for j in range(place["h"])}
        assert not cells & taken, panel["title"]
        assert max(x for x, _ in cells) < 24
        taken |= cells


def test_alerts_and_scraping(deploy: Path, exposed: dict[str, set[str]]) -> None:
    alerts = yaml.safe_load((deploy / "prometheus" / "alerts.yml").read_text())
    for expression in expressions_of(alerts):
        check_expression(expression, exposed)
    settings = yaml.safe_load((deploy / "prometheus" / "prometheus.yml").read_text())
    assert [(deploy / "prometheus" / name).exists() for name in settings["rule_files"]] == [True]
    jobs = {entry["job_name"] for entry in settings["scrape_configs"]}
    assert set(re.findall(r'job="([^"]+)"', json.dumps(alerts).replace('\\"', '"'))) == jobs


def test_alerts_name_outcomes_that_there_are(deploy: Path) -> None:
    reasons = {name.removeprefix("REJECT_REASON_").lower() for name in pb.RejectReason.keys()}  # noqa: SIM118
    text = (deploy / "prometheus" / "alerts.yml").read_text()
    named = {name for found in re.findall(r'outcome=~?"([^"]+)"', text) for name in found.split("|")}
    assert named
    assert named <= reasons


def check_command(command: str, arguments: list[str]) -> None:
    """Has the program parse them as if they had been typed."""
    root = typer.main.get_command(app)
    known = root.get_command(typer.Context(root), command)  # type: ignore[attr-defined]
    assert known is not None
    known.make_context(command, list(arguments))


def settings_of(unit: Path) -> ConfigParser:
    parser = ConfigParser(strict=False, interpolation=None, comment_prefixes=("#",))
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(unit.read_text().replace("\\\n", " "))
    return parser


@pytest.mark.parametrize("name", UNITS)
def test_units_start_what_there_is(deploy: Path, name: str) -> None:
    settings = settings_of(deploy / "systemd" / name)["Service"]
    file = deploy / "systemd" / Path(settings["EnvironmentFile"]).name
    variables = dict(line.split("=", 1) for line in file.read_text().splitlines() if line and not line.startswith("#"))
    given = {"CREDENTIALS_DIRECTORY": "/run/credentials", "STATE_DIRECTORY": "/var/lib/cable-rpc", **variables}
    program, command, *words = shlex.split(settings["ExecStart"])
    assert program == "/opt/cable-rpc/bin/cable-rpc"
    arguments: list[str] = []
    for word in words:
        # systemd splits $NAME into words, and ${NAME} not.
        if word.startswith("$") and not word.startswith("${"):
            arguments += given[word[1:]].split()
        else:
            arguments.append(re.sub(r"\$\{(\w+)\}", lambda found: given[found[1]], word))
    check_command(command, arguments)
    used = set(re.findall(r"\$\{?(\w+)\}?", settings["ExecStart"]))
    assert used - {"CREDENTIALS_DIRECTORY", "STATE_DIRECTORY"} == set(variables)


@pytest.mark.parametrize("name", UNITS)
def test_units_give_nothing_away(deploy: Path, name: str) -> None:
    settings = settings_of(deploy / "systemd" / name)["Service"]
    for setting, value in {
        "NoNewPrivileges": "yes",
        "ProtectSystem": "strict",
        "DynamicUser": "yes",
        "CapabilityBoundingSet": "",
    }.items():
        assert settings[setting] == value
    assert settings["Restart"] in {"always", "on-failure"}


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_finds_nothing_wrong(deploy: Path, tmp_path: Path) -> None:
    for name in UNITS:
        # It looks for the program too, which is not installed where the units say.
        text = (deploy / "systemd" / name).read_text().replace("/opt/cable-rpc/bin/cable-rpc", sys.executable)
        (tmp_path / name).write_text(text)
    checked = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *(str(tmp_path / name) for name in UNITS)],
        capture_output=True,
        text=True,
        check=False,
    )
    about_ours = [line for line in checked.stderr.splitlines() if "cable-rpc" in line]
    assert not about_ours
    assert checked.returncode == 0, checked.stderr


def instructions(deploy: Path) -> list[tuple[str, str]]:
    text = re.sub(r"^#.*\n", "", (deploy / "Containerfile").read_text(), flags=re.MULTILINE).replace("\\\n", " ")
    return [(line.split(maxsplit=1)[0], line.split(maxsplit=1)[1].strip()) for line in text.splitlines() if line]


def test_the_container_runs_what_there_is(deploy: Path, repository: Path) -> None:
    steps = instructions(deploy)
    assert {name for name, _ in steps} <= {
        "ARG", "FROM", "ENV", "RUN", "WORKDIR", "COPY", "USER", "VOLUME", "EXPOSE", "STOPSIGNAL", "HEALTHCHECK",
        "ENTRYPOINT", "CMD",
    }  # fmt: skip
    last_stage = steps[max(place for place, (name, _) in enumerate(steps) if name == "FROM") :]
    assert [value for name, value in last_stage if name == "USER"] == ["10001"]
    for value in (value for name, value in steps if name == "COPY"):
        *sources, _ = value.split()
        assert value.startswith("--from=") or all((repository / source).exists() for source in sources)
    (command,) = [json.loads(value) for name, value in steps if name == "CMD"]
    check_command(command[0], command[1:])
    assert "EXPOSE 50051 9464" in (f"{name} {value}" for name, value in steps)


def test_the_containers_probe_follows_the_server(deploy: Path) -> None:
    (probe,) = [value for name, value in instructions(deploy) if name == "HEALTHCHECK"]
    words = json.loads(probe[probe.index("CMD ") + 4 :])
    serving = True
    with MetricsEndpoint("127.0.0.1:0", ServerMetrics().registry, lambda: serving) as endpoint:
        command = [sys.executable, *(word.replace(":9464/", f":{endpoint.port}/") for word in words[1:])]
        assert words[0] == "python"
        assert subprocess.run(command, check=False, capture_output=True).returncode == 0
        serving = False
        assert subprocess.run(command, check=False, capture_output=True).returncode == 1
    assert subprocess.run(command, check=False, capture_output=True).returncode == 1
