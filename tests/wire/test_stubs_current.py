"""The committed stubs say what the .proto says."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from importlib.resources import files
from itertools import pairwise
from pathlib import Path

from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.rpc import status_pb2

from cable_rpc.wire.v1 import perception_pb2 as pb


def compiled(repository: Path, tmp_path: Path) -> FileDescriptorProto:
    out = tmp_path / "descriptors.bin"
    subprocess.run(
        [
            sys.executable,
            "-m",
            "grpc_tools.protoc",
            f"-Icable_rpc/wire/v1={repository / 'proto' / 'cable' / 'v1'}",
            f"-I{files('grpc_tools') / '_proto'}",
            f"-I{Path(status_pb2.__file__).parents[2]}",
            f"--descriptor_set_out={out}",
            "cable_rpc/wire/v1/perception.proto",
        ],
        check=True,
    )
    return FileDescriptorSet.FromString(out.read_bytes()).file[0]


def test_messages_and_service_equal_the_proto(repository: Path, tmp_path: Path) -> None:
    committed = FileDescriptorProto()
    pb.DESCRIPTOR.CopyToProto(committed)
    fresh = compiled(repository, tmp_path)
    for descriptor in (committed, fresh):
        descriptor.ClearField("source_code_info")
        for message in descriptor.message_type:
            for field in message.field:
                field.ClearField("json_name")
    assert committed == fresh, "the stubs are stale: run `make proto`"


def test_grpc_stub_names_every_method(repository: Path) -> None:
    text = (repository / "cable_rpc" / "wire" / "v1" / "perception_pb2_grpc.py").read_text()
    service = pb.DESCRIPTOR.services_by_name["PerceptionService"]
    for method in service.methods:
        assert f"/cable.v1.PerceptionService/{method.name}'" in text


def test_type_stub_names_every_field(repository: Path) -> None:
    tree = ast.parse((repository / "cable_rpc" / "wire" / "v1" / "perception_pb2.pyi").read_text())
    classes = {node.name: ast.unparse(node) for node in tree.body if isinstance(node, ast.ClassDef)}
    for name, message in pb.DESCRIPTOR.message_types_by_name.items():
        for field in message.fields:
            assert re.search(rf"\b{field.name}\b", classes[name]), f"{name}.{field.name}"


def test_every_field_and_enum_value_is_documented(repository: Path) -> None:
    lines = (repository / "proto" / "cable" / "v1" / "perception.proto").read_text().splitlines()
    declared = re.compile(r"^\s+(optional |repeated )?[\w.]+ \w+ = \d+;|^\s+[A-Z0-9_]+ = \d+;|^(message|enum|service) ")
    undocumented = [
        line.strip() for before, line in pairwise(lines) if declared.match(line) and not before.strip().startswith("//")
    ]
    assert not undocumented
