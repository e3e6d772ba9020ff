"""The tree as a colcon package: package.xml, CMakeLists.txt and msg/ agree with each other and the code."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

import neurosim_core
from cortex_ros2_bridge.convert import RULES
from cortex_ros2_bridge.typestore import definitions, typestore

ROOT = Path(__file__).resolve().parents[2]
MESSAGES = sorted(path.name for path in (ROOT / "msg").glob("*.msg"))


def manifest() -> ElementTree.Element:
    return ElementTree.parse(ROOT / "package.xml").getroot()


def depends(*kinds: str) -> set[str]:
    return {element.text or "" for kind in kinds for element in manifest().iter(kind)}


def commands() -> list[tuple[str, list[str]]]:
    """Names and arguments of all commands of CMakeLists.txt; none is nested in an argument."""
    text = re.sub(r"^\s*#.*$", "", (ROOT / "CMakeLists.txt").read_text(encoding="utf-8"), flags=re.MULTILINE)
    found = re.findall(r"(\w+)\s*\(((?:\"(?:[^\"\\]|\\.)*\"|[^()\"])*)\)", text)
    return [
        (
            name,
            [quoted or plain for quoted, plain in re.findall(r"\"((?:[^\"\\]|\\.)*)\"|([^\s\"]+)", inside)],
        )
        for name, inside in found
    ]


def calls(name: str) -> list[list[str]]:
    return [arguments for command, arguments in commands() if command == name]


def interfaces() -> tuple[list[str], list[str]]:
    """Files and dependencies of the messages that are generated."""
    (arguments,) = calls("rosidl_generate_interfaces")
    split = arguments.index("DEPENDENCIES")
    return arguments[1:split], arguments[split + 1 :]


def test_the_package_says_who_it_is():
    root = manifest()
    assert (root.tag, root.get("format")) == ("package", "3")
    assert root.findtext("name") == "neurosim"
    assert root.findtext("version") == neurosim_core.__version__
    assert root.findtext("license") == "Apache-2.0"
    assert root.findtext("export/build_type") == "ament_cmake"
    assert root.findtext("member_of_group") == "rosidl_interface_packages"
    assert all(root.findtext(tag, "").strip() for tag in ("description", "maintainer"))
    (project,) = calls("project")
    assert project[:3] == ["neurosim", "VERSION", neurosim_core.__version__]


def test_all_messages_are_generated_and_brought_along():
    files, _ = interfaces()
    assert files == [*(f"msg/{name}" for name in MESSAGES), "srv/Reset.srv"]
    assert MESSAGES
    for name in MESSAGES:
        text = (ROOT / "msg" / name).read_text(encoding="utf-8")
        assert definitions()[f"neurosim/msg/{name.removesuffix('.msg')}"] == text
    ours = {name for name in definitions() if name.startswith("neurosim/msg/")}
    assert ours == {f"neurosim/msg/{name.removesuffix('.msg')}" for name in MESSAGES}


def test_what_messages_consist_of_is_depended_on():
    _, dependencies = interfaces()
    used = set()
    for name in MESSAGES:
        for desc in typestore().fielddefs[f"neurosim/msg/{name.removesuffix('.msg')}"][1]:
            used |= {part.split("/")[0] for part in re.findall(r"\w+/msg/\w+", str(desc))}
    assert used == set(dependencies) == depends("depend")
    found = {arguments[0] for arguments in calls("find_package")}
    assert used | depends("buildtool_depend") == found
    assert "rosidl_default_runtime" in depends("exec_depend")
    assert calls("ament_export_dependencies") == [["rosidl_default_runtime"]]


def test_what_the_bridge_sends_and_receives_is_depended_on():
    packages = {rule.ros_type.split("/")[0] for rule in RULES}
    assert packages - {"neurosim"} <= depends("depend", "exec_depend")


@pytest.mark.parametrize("name", MESSAGES)
def test_messages_are_written_as_rosidl_wants_them(name):
    """Names, and that each field says what it is: a unit or a sentence, or that of its message does."""
    assert re.fullmatch(r"[A-Z][A-Za-z0-9]*\.msg", name)
    text = (ROOT / "msg" / name).read_text(encoding="utf-8")
    assert text.startswith("# ")
    for line in text.splitlines():
        code = line.partition("#")[0].strip()
        if not code:
            continue
        constant = re.fullmatch(r"[a-z0-9]+\s+([A-Z][A-Z0-9_]*)=\S+", code)
        field = re.fullmatch(r"(?:[a-z0-9_]+/[A-Z]\w*|[a-z]+\d*)(?:\[\d*\])?\s+([a-z](?:_?[a-z0-9]+)*)", code)
        assert constant or field, line


def test_a_workspace_has_no_copy_of_the_python_packages():
    """Sourced, it would hide those of pip: a bag was once written by an old copy, and lacked the commands."""
    assert not calls("ament_python_install_package")
    sources = {
        argument for command, arguments in commands() if command == "install" for argument in arguments
    }
    assert not sources & {path.parent.name for path in ROOT.glob("*/__init__.py")}


def test_launch_files_and_rviz_are_installed():
    directories = [arguments for arguments in calls("install") if arguments[0] == "DIRECTORY"]
    assert directories == [["DIRECTORY", "launch", "rviz", "DESTINATION", "share/${PROJECT_NAME}"]]
    assert (ROOT / "launch" / "simulation.launch.py").is_file()
    assert list((ROOT / "rviz").glob("*.rviz"))


def test_programs_are_those_of_pip():
    tomllib = pytest.importorskip("tomllib")
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
    (loop,) = calls("foreach")
    programs = dict(argument.split() for argument in loop[1:])
    assert {name: f"{module}.__main__:main" for name, module in programs.items()} == scripts


def test_commands_are_in_an_order_that_works():
    names = [name for name, _ in commands()]
    assert names[:2] == ["cmake_minimum_required", "project"]
    assert names[-1] == "ament_package"
    last_found = len(names) - 1 - names[::-1].index("find_package")
    assert last_found < names.index("rosidl_generate_interfaces")


def test_rosidl_takes_our_messages(tmp_path: Path):
    """Where ROS is sourced: its own parser."""
    adapter = pytest.importorskip("rosidl_adapter.msg")
    for name in MESSAGES:
        made = adapter.convert_msg_to_idl(ROOT, "neurosim", Path("msg") / name, tmp_path)
        assert f"struct {name.removesuffix('.msg')}" in made.read_text(encoding="utf-8")
