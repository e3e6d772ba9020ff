"""Settings: every mistake is named with its path, its value and what is allowed; YAML round-trips."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from neurosim_core.config import ConfigError, SimulationConfig, load_config, to_yaml
from neurosim_core.flight_report import absent_sensors
from neurosim_core.live.config import LinkConfig
from neurosim_core.settings import BaseConfig, documentation


def test_defaults_are_what_the_manual_says():
    config = load_config()
    assert config.duration_s == 4.0
    lens = config.sensors["events"].lens
    assert (lens.width, lens.height) == (346, 260)
    assert config.sensors["rgb"].rate_hz == config.sensors["depth"].rate_hz == 20.0
    assert config.sensors["imu"].rate_hz == 400.0
    assert config.scene.kind == "apartment"


@pytest.mark.parametrize("comments", [False, True])
def test_yaml_round_trip(comments):
    config = load_config({"scene": {"seed": 3}, "sensors": {"cam": {"kind": "rgb", "rate_hz": 30}}})
    assert load_config(yaml.safe_load(to_yaml(config, comments=comments))) == config


def test_every_key_is_documented():
    def undocumented(model: type[BaseModel], path: str) -> Iterator[str]:
        described = documentation(model)
        for name in model.model_fields:
            if not described.get(name):
                yield f"{path}.{name}"

    def subclasses(cls: type) -> Iterator[type]:
        for sub in cls.__subclasses__():
            yield sub
            yield from subclasses(sub)

    models = [m for m in subclasses(BaseConfig) if m.__module__.startswith("neurosim_core")]
    assert len(models) > 10
    tagged = {"kind"}  # says of itself what it is
    missing = [p for m in models for p in undocumented(m, m.__name__) if p.rsplit(".", 1)[-1] not in tagged]
    assert not missing


UNLIT = {"mode": "unshadowed", "edge_max_m": 0.1}
VOLTMETER = {"preset": "voltmeter_dvs346", "threshold_on": 0.3}
WITHOUT_EFFECT = [
    ({"render": {"lighting": UNLIT}}, ["render.lighting", "edge_max_m", "unshadowed"]),
    (
        {"sensors": {"e": {"kind": "event_camera", "pixel": VOLTMETER}}},
        ["e.pixel: threshold_on does nothing"],
    ),
    ({"sensors": {"e": {"kind": "event_camera", "classes": {"a": ["*"]}}}}, ["e: classes", "label semantic"]),
    ({"sensors": {"c": {"kind": "rgb", "shutter": {"direction": "up"}}}}, ["direction", "readout_s is 0"]),
    ({"sensors": {"c": {"kind": "rgb", "shutter": {"exposure_samples": 4}}}}, ["exposure_s is 0, got 4"]),
    ({"path": {"height_min_m": 2.0}}, ["path: height_min_m must be below height_max_m = 1.7, got 2"]),
]
UNITS = [
    ({"sensors": {"c": {"kind": "rgb", "mount": {"rpy_rad": [0, 90, 0]}}}}, ["write [0.0, 1.570796, 0.0]"]),
    ({"sensors": {"c": {"kind": "imu", "mount": {"position_m": [100, 0, 30]}}}}, ["write [0.1, 0.0, 0.03]"]),
    ({"sensors": {"c": {"kind": "rgb", "shutter": {"readout_s": 0.1}}}}, ["1 / rate_hz = 0.05, got 0.1"]),
    ({"sensors": {"a": {"kind": "gps", "delay_s": 1e9}}}, ["sensors.a.delay_s", "60"]),
    ({"vehicle": {"parameters": {"wind_m_s": [3000, 0, 0]}}}, ["wind_m_s.0", "200, got 3000"]),
    ({"vehicle": {"max_step_s": 1e-12}}, ["vehicle.max_step_s", "1e-12"]),
    ({"path": {"limits": {"speed_max_m_s": 1e9}}}, ["path.limits.speed_max_m_s", "200"]),
    ({"free_space": {"voxel_m": 1e-9}}, ["free_space.voxel_m", "1e-09"]),
]
WRONG = [
    *WITHOUT_EFFECT,
    *UNITS,
    ({"duration_s": -1.0}, ["duration_s", "greater than 0", "-1.0"]),
    ({"duration_ms": 4000}, ["duration_ms", "unknown key", "duration_s"]),
    ({"duration_s": "4 s"}, ["duration_s", "valid number", "'4 s'"]),
    ({"duration_s": float("nan")}, ["duration_s", "finite"]),
    ({"device": "gpu"}, ["device", "gpu"]),
    ({"scene": {"kind": "castle"}}, ["scene.kind", "castle", "apartment", "mesh"]),
    ({"scene": {"kind": "mesh"}}, ["scene.file", "required"]),
    ({"sensors": {"x": {"rate_hz": 3}}}, ["sensors.x.kind", "required"]),
    ({"scene": {"kind": "apartment", "romms": 4}}, ["scene.romms", "unknown key", "'rooms'"]),
    ({"vehicle": {"preset": "zeppelin"}}, ["zeppelin", "crazyflie", "hummingbird", "racer"]),
    ({"vehicle": {"parameters": {"mass_kg": 0.0}}}, ["vehicle: parameters.mass_kg", "greater than 0", "0.0"]),
    ({"vehicle": {"parameters": {"mass": 1.0}}}, ["parameters.mass", "unknown key", "'mass_kg'"]),
    ({"renderer": "opengl"}, ["renderer", "opengl", "pyrender"]),
    ({"control": {"gains": {"position_gain_per_s2": -1}}}, ["control.gains.position_gain_per_s2", "-1"]),
    (
        {"sensors": {"dvs": {"kind": "event_camera", "pixel": {"threshold_on": 0.0}}}},
        ["sensors.dvs.pixel.threshold_on", "0.0"],
    ),
    (
        {"sensors": {"dvs": {"kind": "event_camera", "treshold": 0.2}}},
        ["sensors.dvs.treshold", "unknown key", "pixel"],
    ),
    (
        {"sensors": {"dvs": {"kind": "event_camera", "sampling_rate_hz": 500, "packet_rate_hz": 30}}},
        ["sensors.dvs", "packet_rate_hz must divide", "500", "30"],
    ),
    ({"path": {"kind": "tour", "clearance_m": 0.2}}, ["path.clearance_m", "collision_radius_m = 0.2"]),
    ({"sensors": {"a b": {"kind": "rgb"}}}, ["sensors", "a b"]),
    ({"sensors": {"collision": {"kind": "rgb"}}}, ["sensors", "collision", "taken"]),
    ({"sensors": {"x": {"kind": "sonar"}}}, ["sensors.x.kind", "sonar", "event_camera"]),
]


SAID = [
    (
        {"parameters": {"rotor_thrust_scale": [1, 1]}},
        "parameters: rotor_thrust_scale must have one entry for each of 4 rotors, or none, got 2",
    ),
    (
        {"parameters": {"gusts": {"start_s": 1}}},
        "parameters.gusts: must be a list, such as [{velocity_m_s: ..., start_s: ...}], got {'start_s': 1}",
    ),
    (
        {"parameters": {"ground": {"foot_position_m": [[0, 0]]}}},
        "parameters.ground.foot_position_m.0: must be a list of 3 numbers, such as [1, 2, 3], got [0, 0]",
    ),
    (
        {"parameters": {"wind_m_s": 3}},
        "parameters.wind_m_s: must be a list of 3 numbers, such as [1, 2, 3], got 3",
    ),
    (
        {"parameters": {"ground": 0}},
        "parameters.ground: must be keys with values, such as {height_m: 0, "
        "foot_position_m: ...}, or null, got 0",
    ),
]


@pytest.mark.parametrize(("vehicle", "said"), SAID)
def test_parameters_are_explained_as_they_are_written(vehicle: dict[str, Any], said: str):
    """One line, without the values of all other parameters and without names of classes."""
    with pytest.raises(ConfigError) as error:
        load_config({"vehicle": vehicle})
    assert str(error.value).splitlines()[1:] == [f"  vehicle: {said}"]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            "sensors: {e: {kind: event_camera, pixel: {threshold_spread: {on: 0.1}}}}",
            "sensors.e.pixel.threshold_spread: a key is on, yes or true, which YAML reads as true; "
            "known: minimum, sigma_off, sigma_on",
        ),
        (
            "sensors: {e: {kind: event_camera, pixel: {leak: 0.1}}}",
            "sensors.e.pixel.leak: must be keys with values, such as {rate_hz: 0.1, spread_decades: 0.1}, "
            "or null, got 0.1",
        ),
        (
            "sensors: {events: {kind: event_camera}, event: {lens: {width: 9}}}",
            "sensors.event.kind: required, and not given (there is no sensor 'event'; a kind makes one); "
            "did you mean 'events'?",
        ),
        (
            "sensors: {e: {kind: event_camera, horizontal_fov_rad: 1.2}}",
            "sensors.e.horizontal_fov_rad: unknown key; did you mean 'lens.horizontal_fov_rad'? known:",
        ),
        (
            "vehicle: {wind_m_s: [3, 0, 0]}",
            "vehicle.wind_m_s: this is one of the parameters: vehicle.parameters.wind_m_s",
        ),
        (
            "vehicle: {parameters: {wind: 3}}",
            "vehicle: parameters.wind: unknown key; did you mean 'wind_m_s'? known:",
        ),
        (
            "bodies: {1ball: {shape: {kind: sphere}}}",
            "bodies.1ball: a name is a letter, then letters, digits and _, got '1ball'",
        ),
        (
            "bodies: {ball: {shape: {kind: sphere}, motion: {sway: {freq: 1}}}}",
            "bodies.ball.motion.sway.freq: unknown key; did you mean 'frequency_hz'?",
        ),
        (
            "path: {kind: waypoints, points_m: [[1, 2, 3]]}",
            "path.points_m: must have at least 2 items, got [[1, 2, 3]]",
        ),
        (
            "path: {kind: waypoints, points_m: 3}",
            "path.points_m: must be a list of lists of 3 numbers, got 3",
        ),
        ("scene: {kind: mesh, file: 3}", "scene.file: must be the name of a file, got 3"),
        ("sensors: {imu: 3}", "sensors.imu: must be keys with values, such as {kind: barometer or contact"),
        ("no: 3", "a key is off, no or false, which YAML reads as false; known: bodies,"),
        ("3: 3", "keys must be text, got 3; known: bodies,"),
    ],
)
def test_mistakes_are_told_in_the_words_of_the_file(settings: str, said: str):
    with pytest.raises(ConfigError) as error:
        load_config(yaml.safe_load(settings))
    (line,) = str(error.value).splitlines()[1:]
    assert line.startswith(f"  {said}")


@pytest.mark.parametrize(
    ("settings", "named"), WRONG, ids=[f"{next(iter(w[0]))}-{i}" for i, w in enumerate(WRONG)]
)
def test_mistakes_are_named(settings: dict[str, Any], named: list[str]):
    with pytest.raises(ConfigError) as error:
        load_config(settings)
    for text in named:
        assert text in str(error.value)


def test_all_mistakes_are_told_at_once():
    with pytest.raises(ConfigError) as error:
        load_config({"duration_s": 0, "seed": -1, "cat": 1})
    assert len(str(error.value).splitlines()) == 4


def test_mistakes_in_options_are_said_of_the_options(tmp_path):
    """Whoever gave a value on the command line never saw its key; one in a file keeps its key."""
    options = {"duration_s": "--duration", "sensors.imu.rate_hz": "--rates", "control.rate_hz": "--rates"}

    def said(source: Any, **overrides: Any) -> str:
        with pytest.raises(ConfigError) as caught:
            load_config(source, overrides=overrides, options=options)
        return str(caught.value)

    assert said(None, duration_s=-1.0) == "--duration: Input should be greater than 0, got -1.0"
    rates = {"sensors.imu.rate_hz": 0, "control.rate_hz": 0}
    assert said(None, **rates) == "--rates: Input should be greater than 0, got 0"
    both = said(None, duration_s=-1.0, **rates).splitlines()
    assert both[0] == "wrong options:"
    assert sorted(line.split(":")[0] for line in both[1:]) == ["  --duration", "  --rates"]
    file = tmp_path / "scene.yaml"
    file.write_text("seed: -4\n")
    lines = said(file, duration_s=0.0).splitlines()
    assert lines[0] == f"{file} is not a valid configuration:"
    assert any(line.startswith("  seed: ") for line in lines)
    assert any(line.startswith("  --duration: ") for line in lines)
    options["scene"] = "--set scene"
    assert said(None, **{"scene.rooms": 0}).startswith("--set scene: scene.rooms: ")
    options["sensors.rgb.rate_hz"] = "--set sensors.rgb.rate_hz"
    file.write_text("sensors: {rgb: {lens: {}}}")  # lacks its kind, whatever the option says
    head, line = said(file, **{"sensors.rgb.rate_hz": 3.0}).splitlines()
    assert (head, line[:19]) == (f"{file} is not a valid configuration:", "  sensors.rgb.kind:")


def test_a_device_is_named_by_what_may_be_given():
    with pytest.raises(ConfigError, match="device: must be auto, cpu, cuda, or cuda:0 and so on, got 'gpu'"):
        load_config({"device": "gpu"})


def test_overrides_win_and_may_be_dotted(tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text("duration_s: 3\nscene: {kind: apartment, seed: 1}\n")
    config = load_config(file, overrides={"scene.seed": 5, "duration_s": 2.0})
    assert (config.duration_s, config.scene.seed) == (2.0, 5)
    assert load_config(file, overrides={"scene": {"kind": "mesh", "file": "/a.glb"}}).scene.kind == "mesh"


def test_a_preset_counts_for_the_default_sensors():
    """The default set gives way to it: `neurosim run --set sensors.events.pixel.preset=davis346`."""
    expected = load_config({"sensors": {"events": {"kind": "event_camera", "pixel": {"preset": "davis346"}}}})
    for overrides in (
        {"sensors.events.pixel.preset": "davis346"},
        {"sensors.events.pixel": {"preset": "davis346"}},
    ):
        config = load_config(overrides=overrides)
        assert config.sensors["events"] == expected.sensors["events"]
        assert config.sensors["events"].pixel.leak is not None
        assert config.sensors.keys() == load_config().sensors.keys()


def test_sensors_can_be_added_to_the_default_set(tmp_path):
    file = tmp_path / "rig.yaml"
    file.write_text("sensors+: {rgb: {rate_hz: 40}, depth: null, rear: {kind: rgb}}")
    config = load_config(file, overrides={"sensors.imu.rate_hz": 100})
    assert list(config.sensors) == ["events", "rgb", "imu", "odometry", "rear"]
    assert (config.sensors["rgb"].rate_hz, config.sensors["imu"].rate_hz) == (40.0, 100.0)
    assert config.sensors["events"] == load_config().sensors["events"]
    with pytest.raises(ConfigError, match="give `sensors`, which replace the default set, or `sensors\\+`"):
        load_config({"sensors": {}, "sensors+": {}})


def test_sensors_that_a_file_leaves_out_are_named():
    absent = absent_sensors(load_config({"sensors": {"events": {"kind": "event_camera"}}}))
    assert "Absent of the default sensors: rgb, depth, imu, odometry." in absent
    assert "`sensors+` adds" in absent
    assert absent_sensors(load_config()) == ""


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ({"seed": 3}, "tour"),
        ({"points_m": [[0, 0, 1], [1, 0, 1]]}, "waypoints"),
        ({"file": "poses.txt"}, "poses"),
    ],
)
def test_the_kind_of_a_path_follows_from_keys_that_one_kind_has(path, kind):
    assert load_config({"path": path}).path.kind == kind


def test_the_kind_of_a_scene_follows_from_its_keys(tmp_path):
    assert load_config({"scene": {"file": "/a.glb"}}).scene.kind == "mesh"
    assert load_config({"scene": {"rooms": 2}}).scene.kind == "apartment"
    with pytest.raises(ConfigError, match=r"scene.path: unknown key; the file of a scene is scene.file"):
        load_config({"scene": {"path": "a.glb"}})
    with pytest.raises(ConfigError, match=r"scene.file: required, and not given"):
        load_config({"scene": {"up_axis": "z"}})


def test_an_angle_in_degrees_is_told():
    lens = {"width": 64, "height": 48, "horizontal_fov_rad": 90}
    with pytest.raises(ConfigError, match=r"got 90; if these are degrees, write 1\.5708"):
        load_config({"sensors": {"rgb": {"kind": "rgb", "lens": lens}}})


def test_null_leaves_sensors_and_bodies_out():
    config = load_config(overrides={"sensors.depth": None, "sensors.rgb": None})
    assert list(config.sensors) == ["events", "imu", "odometry"]
    bodies = {"ball": {"shape": {"kind": "sphere"}}, "crate": {"shape": {"kind": "box"}}}
    assert list(load_config({"bodies": bodies}, overrides={"bodies.ball": None}).bodies) == ["crate"]


def test_overrides_change_the_default_sensors(tmp_path):
    """Where the source names no sensors, a key of one changes that one and leaves the others."""
    config = load_config(overrides={"sensors.events.pixel.threshold_on": 0.3, "sensors.rgb.lens.width": 640})
    default = load_config()
    assert set(config.sensors) == set(default.sensors)
    assert config.sensors["events"].pixel.threshold_on == 0.3
    assert config.sensors["rgb"].lens.width == 640
    assert config.sensors["imu"] == default.sensors["imu"]
    more = load_config(overrides={"sensors": {"left": {"kind": "rgb"}}})
    assert set(more.sensors) == {*default.sensors, "left"}
    named = load_config({"sensors": {"left": {"kind": "rgb"}}}, overrides={"sensors.left.rate_hz": 5})
    assert set(named.sensors) == {"left"}


@pytest.mark.parametrize(
    ("sampling_hz", "packets_hz"), [(500, 100), (1000, 100), (240, 80), (250, 62.5), (333, 83.25), (30, 30)]
)
def test_packets_end_on_renders_whatever_the_rate(sampling_hz, packets_hz):
    config = load_config({"sensors": {"dvs": {"kind": "event_camera", "sampling_rate_hz": sampling_hz}}})
    assert config.sensors["dvs"].packets.rate_hz == packets_hz


def test_a_scene_file_is_a_mesh(tmp_path):
    assert load_config({"scene": {"file": "/a.glb"}}).scene.kind == "mesh"


def test_scene_file_is_relative_to_the_settings_file(tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text("scene: {kind: mesh, file: house.glb}\n")
    assert load_config(file).scene.file == tmp_path / "house.glb"


@pytest.mark.parametrize(
    ("text", "named"), [("[1, 2]", "mapping"), ("a: [", "not YAML"), ("a: 'x\n b: {", "not YAML")]
)
def test_files_that_are_no_settings(tmp_path, text, named):
    file = tmp_path / "scene.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=named):
        load_config(file)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"nothing\.yaml"):
        load_config(tmp_path / "nothing.yaml")


def test_empty_file_is_the_default(tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text("# nothing\n")
    assert load_config(file) == SimulationConfig()


def test_config_is_frozen():
    with pytest.raises(ValueError, match="frozen"):
        load_config().duration_s = 1.0  # type: ignore[misc]


json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda children: (
        st.lists(children, max_size=3) | st.dictionaries(st.text(max_size=5), children, max_size=3)
    ),
    max_leaves=5,
)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("duration_s", "yes", "duration_s: must be a number, got True"),
        ("seed", "off", "seed: must be a number, got False"),
        ("sensors.e", "{kind: imu, mount: {position_m: [0, on, 0]}}",
         "sensors.e.mount.position_m: must be a number, got [0, True, 0]"),
        ("sensors.e", "{kind: event_camera, pixel: {threshold_on: true}}",
         "sensors.e.pixel.threshold_on: must be a number, got True"),
    ],
)  # fmt: skip
def test_a_truth_value_is_no_number(key, value, said):
    with pytest.raises(ConfigError, match=re.escape(said)):
        load_config(overrides={key: yaml.safe_load(value)})
    assert load_config(overrides={"live.run_on": True}).live.run_on


@given(st.sampled_from(sorted(SimulationConfig.model_fields)), json)
def test_any_value_is_taken_or_refused_by_name(key, value):
    message = ""
    try:
        config = load_config({key: value})
    except ConfigError as error:
        message = str(error)
    assert key in message or isinstance(config, SimulationConfig)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"links": {"nix": {}}}, "links.nix: vehicle 'drone' has no such link, known: events, rgb"),
        (
            {"links": {"command": {"clock_offset_s": 1.0}}},
            "clock_offset_s and clock_drift_ppm are for links of sensors",
        ),
        ({"links": {"imu": {"loss": 1.5}}}, "links.imu.loss: .* less than or equal to 1, got 1.5"),
        ({"vehicles": {}}, "vehicles: .* at least 1 item"),
        ({"vehicles": {"b": {"sensors": {"path": {"kind": "imu"}}}}}, "'path' is taken by the planned path"),
        (
            {"vehicles": {"b": {"control": {"rate_hz": 50}}}},
            r"vehicles.b.control.rate_hz must be .* 200, got 50",
        ),
        ({"sensors": {"odometry": {"kind": "imu"}}}, "named 'odometry' must be of kind odometry, got imu"),
        ({"sensors": {"imu_link": {"kind": "imu"}}}, "must not end in '_link'"),
    ],
)
def test_mistakes_in_a_live_configuration_are_explained(settings, message):
    with pytest.raises(ConfigError, match=message):
        load_config(settings)


def test_a_member_of_a_fleet_has_what_is_common_and_what_is_its_own():
    own = {"path": {"kind": "hover"}, "links": {"command": {"latency_s": 0.008}}}
    config = load_config({"seed": 5, "vehicles": {"a": {}, "b": own, "c": {}}})
    a, b, c = (config.of(name) for name in "abc")
    assert (a.seed, a.path, a.links) == (5, config.path, {})
    assert b.path.kind == "hover"
    assert b.links["command"].latency_s == 0.008
    assert len({a.seed, b.seed, c.seed}) == 3
    assert c.path == config.path.model_copy(update={"seed": 2})  # else it would fly inside the first
    assert list(b.vehicles) == ["b"]
    with pytest.raises(KeyError, match="unknown vehicle 'd', known: a, b, c"):
        config.of("d")


def test_the_clock_of_a_sensor_is_exact_to_the_nanosecond():
    link = LinkConfig(clock_offset_s=0.003, clock_drift_ppm=40.0)
    assert [link.clock_ns(s) for s in (0, 10**9, 3_600 * 10**9)] == [
        3_000_000,
        1_003_040_000,
        3_600 * 10**9 + 3_000_000 + 144_000_000,
    ]
    assert LinkConfig().clock_ns(123) == 123
