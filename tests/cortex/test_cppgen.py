"""The generator of C++ structs: names, guards, text; what its code does is tested in test_cpp.py."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from cortex.cppgen import generate
from cortex.layout import block_size, has_tail
from cortex.message_types import Array, Int16, UInt8, message
from cortex.schema import EnumType, Field, Schema, schema_of

INCLUDE = Path(__file__).parents[2] / "cortex" / "cpp" / "include"


@message(name="robot/arm/Joint")
class Joint:
    stamp_ns: int
    angle: float


@message(name="robot/Arm")
class Arm:
    joints: list[Joint]
    first: Joint


def _schema(name: str, *fields: Field) -> Schema:
    return Schema(name, fields)


def _compile(text: str, tmp_path: Path, body: str = "") -> subprocess.CompletedProcess[str]:
    if shutil.which("g++") is None:
        pytest.skip("no g++")
    (tmp_path / "generated.hpp").write_text(text)
    program = '#include "generated.hpp"\n#include "generated.hpp"\n' + body + "\nint main() {}\n"
    (tmp_path / "main.cpp").write_text(program)
    return subprocess.run(
        ["g++", "-std=gnu++17", "-fsyntax-only", "-Wall", "-Wextra", "-Werror", f"-I{INCLUDE}", "main.cpp"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=900.0,  # it takes a second; a hang takes longer, also on a machine that does a lot besides
        check=False,
    )


def test_names_become_namespaces():
    text = generate([Arm])
    assert "namespace robot::arm {\nstruct Joint {" in text
    assert "std::vector<::robot::arm::Joint> joints{};" in text
    assert text.index("struct Joint") < text.index("struct Arm")
    assert text.count("struct Joint {") == 1
    flat = generate([Arm], namespace="mine::messages")
    assert "namespace mine::messages {\nstruct Joint {" in flat
    assert "std::vector<::mine::messages::Joint> joints{};" in flat


def test_codec_carries_identity_and_layout():
    schema = schema_of(Joint)
    text = generate([Joint])
    assert f"fingerprint = 0x{schema.fingerprint:016X}u;" in text
    literal = re.search(r'string_view schema = "(.*)";', text)
    assert literal is not None
    assert literal[1].replace('\\"', '"') == schema.to_json()
    assert block_size(schema) == 16
    assert "{CORTEX_MESSAGE, 0, 0, 0, 0, 16, 1, 2, nullptr" in text
    assert "{CORTEX_NUMBER, 100, 0, offsetof(::robot::arm::Joint, angle), 8, 8" in text  # a double
    assert ("fixed = true;" in text) == (not has_tail(schema))
    assert "return static_cast<std::int64_t>(message.stamp_ns);" in text


def test_text_of_units_stays_in_comments_and_strings(tmp_path):
    """Units come from anywhere: they can end neither a comment nor a literal."""
    units = ("m/s²", "??/", "*/ #error no", "\u2028#error no", "// %s", "trigraph ??'")
    fields = [Field(f"f{index}", "float64", unit, unit) for index, unit in enumerate(units)]
    schema = _schema("Units", *fields)
    expected = "".join(f"\\{byte:03o}" for byte in "²".encode())
    assert expected in generate([schema])
    check = f"static_assert(cortex::Codec<Units>::schema.size() == {len(schema.to_json().encode())});"
    done = _compile(generate([schema]), tmp_path, check)
    assert done.returncode == 0, done.stderr


def test_same_types_in_two_headers_are_one(tmp_path):
    done = _compile(
        generate([Joint]) + generate([Arm]).replace("#pragma once", ""), tmp_path, "robot::Arm arm;"
    )
    assert done.returncode == 0, done.stderr


def test_two_types_of_one_name_are_refused():
    one = _schema("Pose", Field("x", "float64"))
    other = _schema("Pose", Field("x", "float32"))
    with pytest.raises(ValueError, match="two different types would both be Pose"):
        generate([one, other])
    mode, another = EnumType("Mode", (("A", 1),)), EnumType("Mode", (("A", 2),))
    with pytest.raises(ValueError, match="two different types would both be Mode"):
        generate([_schema("One", Field("mode", mode)), _schema("Two", Field("mode", another))])
    assert generate([one, one]) == generate([one])


@pytest.mark.parametrize("namespace", ["", "a::", "a b", "1a", "a;", "ü"])
def test_wrong_namespaces_are_refused(namespace):
    with pytest.raises(ValueError, match="namespace must be names"):
        generate([Joint], namespace=namespace)


def test_what_is_no_message_is_refused():
    with pytest.raises(TypeError, match="message"):
        generate([int])
    with pytest.raises(ValueError, match="at least one"):
        generate([])


def test_arrays_are_values_or_views():
    """Small arrays of a fixed shape are values, the others may look into a frame."""

    @message
    class Arrays:
        matrix: Array["float64", 3, 4]
        picture: Array["uint8", 480, 640, 3]
        row: Array["bool", "n"]
        any: Array["any", "h", "w"]
        data: bytes
        small: UInt8
        numbers: list[Int16]

    text = generate([Arrays])
    assert "std::array<std::array<double, 4>, 3> matrix{};  // [3, 4]" in text
    assert "cortex::Array<std::uint8_t, 3> picture{};  // [480, 640, 3]" in text
    assert "cortex::Array<cortex::Bool, 1> row{};  // [n]" in text
    assert "cortex::AnyArray<2> any{};" in text
    assert "cortex::Array<std::uint8_t> data{};" in text
    assert "std::vector<std::int16_t> numbers{};" in text
