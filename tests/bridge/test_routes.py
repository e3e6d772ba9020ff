"""The table of routes: what becomes of which topic by default, and what settings change."""

from __future__ import annotations

import re
from pathlib import Path as FilePath

import pytest
import yaml
from processes import wait_for

from cortex import Node, message
from cortex.messages import (
    AttitudeCommand,
    CameraInfo,
    Clock,
    Collision,
    Delivery,
    Events,
    Image,
    Imu,
    MotorCommand,
    Odometry,
    Path,
    PoseCommand,
    RateThrustCommand,
    Reset,
    RotorSpeeds,
    Simulation,
    SimulatorReply,
    SimulatorStatus,
    Step,
    Transform,
    Trigger,
    VelocityCommand,
)
from cortex.schema import schema_of
from cortex_ros2_bridge import config
from cortex_ros2_bridge.config import ConfigError, load
from cortex_ros2_bridge.routes import Seen, SeenTopic, look, make_routes, unfit, vehicle_of


def topic(name, kind, *, published=True, fingerprint=None):
    schema = schema_of(kind)
    return SeenTopic(name, schema.name, fingerprint or schema.fingerprint, published)


def default_routes(seen):
    return make_routes(seen, config.BridgeConfig())[0]


DRONE = Seen(
    (
        topic("/clock", Clock),
        topic("/drone/collision", Collision),
        topic("/drone/command/attitude", AttitudeCommand, published=False),
        topic("/drone/command/motor_speeds", MotorCommand, published=False),
        topic("/drone/command/position", PoseCommand, published=False),
        topic("/drone/command/rates", RateThrustCommand, published=False),
        topic("/drone/command/velocity", VelocityCommand, published=False),
        topic("/drone/events", Events),
        topic("/drone/events/info", CameraInfo),
        topic("/drone/imu", Imu),
        topic("/drone/imu/transform", Transform),
        topic("/drone/odometry", Odometry),
        topic("/drone/path", Path),
        topic("/drone/rgb", Image),
        topic("/drone/rgb/info", CameraInfo),
        topic("/drone/rgb/transform", Transform),
        topic("/drone/rotor_speeds", RotorSpeeds),
        topic("/simulation", Simulation),
        topic("/status", SimulatorStatus),
    ),
    (("/pause", "cortex/Trigger"), ("/reset", "cortex/Reset"), ("/step", "cortex/Step")),
)


def table(routes):
    return {(str(route), route.ros_type.replace("/msg/", "/")) for route in routes}


def routed(settings, seen=DRONE):
    """Routes by (Cortex topic, last part of the ROS type); there must be no problems."""
    routes, problems = make_routes(seen, load(settings))
    assert not problems
    return {(route.cortex_topic, route.ros_type.rpartition("/")[2]): route for route in routes}


def test_every_standard_topic_has_its_routes():
    """The names that docs and REPs promise, all of them and no others."""
    assert table(default_routes(DRONE)) == {
        ("/clock -> /clock", "rosgraph_msgs/Clock"),
        ("/drone/imu -> /drone/imu", "sensor_msgs/Imu"),
        ("/drone/odometry -> /drone/odometry", "nav_msgs/Odometry"),
        ("/drone/odometry -> /tf", "tf2_msgs/TFMessage"),
        ("/drone/imu/transform -> /tf_static", "tf2_msgs/TFMessage"),
        ("/drone/rgb/transform -> /tf_static", "tf2_msgs/TFMessage"),
        ("/drone/rgb -> /drone/rgb/image_raw", "sensor_msgs/Image"),
        ("/drone/rgb -> /drone/rgb/camera_info", "sensor_msgs/CameraInfo"),
        ("/drone/events -> /drone/events", "event_camera_msgs/EventPacket"),
        ("/drone/events -> /drone/events/image", "sensor_msgs/Image"),
        ("/drone/events -> /drone/events/camera_info", "sensor_msgs/CameraInfo"),
        ("/drone/rotor_speeds -> /drone/rotor_speeds", "actuator_msgs/Actuators"),
        ("/drone/path -> /drone/path", "nav_msgs/Path"),
        ("/drone/command/motor_speeds <- /drone/actuators", "actuator_msgs/Actuators"),
        ("/drone/command/rates <- /drone/attitude_target", "mavros_msgs/AttitudeTarget"),
        ("/drone/command/attitude <- /drone/attitude_target", "mavros_msgs/AttitudeTarget"),
        ("/drone/command/velocity <- /drone/cmd_vel", "geometry_msgs/Twist"),
        ("/drone/command/velocity <- /drone/command_velocity", "geometry_msgs/TwistStamped"),
        ("/drone/command/position <- /drone/command_pose", "geometry_msgs/PoseStamped"),
        (
            "/drone/command/position <- /drone/command_trajectory",
            "trajectory_msgs/MultiDOFJointTrajectory",
        ),
        ("/pause <- /pause", "std_msgs/Empty"),
        ("/reset <- /reset", "std_msgs/Empty"),
        ("/reset <- /reset_to", "neurosim/Reset"),
        ("/simulation -> /simulation", "std_msgs/String"),
        ("/status -> /status", "neurosim/SimulatorStatus"),
        ("/status -> /diagnostics", "diagnostic_msgs/DiagnosticArray"),
        ("/drone/collision -> /drone/collision", "neurosim/Collision"),
        ("/step <- /step", "std_msgs/UInt32"),
    }
    routes, problems = make_routes(DRONE, load(None))
    assert table(routes) == table(default_routes(DRONE))
    assert problems == []


def test_latched_topics_stay_latched():
    """tf_static, path and calibrations without pictures reach those who come later; streams do not."""
    seen = Seen((*DRONE.topics, topic("/drone/lidar/info", CameraInfo)))
    latched = {r.ros_topic for r in default_routes(seen) if r.qos.durability == "transient_local"}
    assert latched == {"/tf_static", "/simulation", "/drone/path", "/drone/lidar/camera_info"}


def test_a_command_that_is_only_published_is_no_route():
    """A recording of commands, or a controller without a simulator, takes no commands from ROS."""
    assert default_routes(Seen((topic("/drone/command/rates", RateThrustCommand),))) == []
    assert default_routes(Seen((topic("/drone/imu", Imu, published=False),))) == []


def test_namespace_spares_what_all_of_ros_expects():
    names = {route.ros_topic for route in routed({"namespace": "neurosim/"}).values()}
    assert {"/clock", "/tf", "/tf_static", "/neurosim/drone/imu", "/neurosim/reset"} <= names
    assert not {"/neurosim/clock", "/neurosim/tf", "/drone/imu"} & names


def test_rename_takes_the_longest_beginning():
    """A whole camera is renamed at once; `/drone/rgbd` would not begin with `/drone/rgb`."""
    seen = Seen((*DRONE.topics, topic("/drone/rgbd", Image)), ())
    routes = routed({"rename": {"/drone": "/quad", "/drone/rgb": "/front"}, "namespace": "/sim"}, seen)
    assert routes["/drone/rgb", "Image"].ros_topic == "/sim/front/image_raw"
    assert routes["/drone/rgb", "CameraInfo"].ros_topic == "/sim/front/camera_info"
    assert routes["/drone/rgbd", "Image"].ros_topic == "/sim/quad/rgbd/image_raw"
    assert routes["/drone/imu", "Imu"].ros_topic == "/sim/quad/imu"


def test_a_named_image_takes_its_calibration_along():
    routes = routed({"routes": [{"cortex": "/drone/rgb", "ros": "/cam/color"}]})
    assert routes["/drone/rgb", "Image"].ros_topic == "/cam/color"
    assert routes["/drone/rgb", "CameraInfo"].ros_topic == "/cam/camera_info"


def test_a_name_without_a_type_is_for_the_main_route():
    routes = routed({"routes": [{"cortex": "/drone/odometry", "ros": "/odom"}]})
    assert routes["/drone/odometry", "Odometry"].ros_topic == "/odom"
    assert routes["/drone/odometry", "TFMessage"].ros_topic == "/tf"


def test_qos_and_options_of_a_pattern():
    """Later entries win, and what they do not name stays."""
    settings = {
        "routes": [
            {
                "cortex": "*",
                "type": "event_camera_msgs/EventPacket",
                "options": {"encoding": "mono", "queue": 1},
            },
            {"cortex": "/drone/*", "qos": "sensor_data"},
            {"cortex": "/drone/events", "options": {"queue": 2}, "qos": {"depth": 7}},
        ]
    }
    routes = routed(settings)
    packets = routes["/drone/events", "EventPacket"]
    assert packets.options == {"encoding": "mono", "queue": 2}
    assert (packets.qos.reliability, packets.qos.depth) == ("best_effort", 7)
    assert routes["/drone/imu", "Imu"].qos == config.QOS["sensor_data"]
    assert routes["/drone/imu", "Imu"].options == {}
    assert routes["/clock", "Clock"].qos == config.QOS["default"]


def test_select():
    assert {
        key[0] for key in routed({"include": ["/drone/*"], "exclude": ["*/events*", "/drone/command/*"]})
    } == {
        "/drone/collision",
        "/drone/imu",
        "/drone/imu/transform",
        "/drone/odometry",
        "/drone/path",
        "/drone/rgb",
        "/drone/rgb/transform",
        "/drone/rotor_speeds",
    }
    off = {"cortex": "/drone/odometry", "type": "tf2_msgs/TFMessage", "enabled": False}
    assert len(routed({"routes": [off]})) == len(routed({})) - 1
    only = {"defaults": False, "routes": [{"cortex": "/drone/rgb"}]}
    assert set(routed(only)) == {("/drone/rgb", "Image"), ("/drone/rgb", "CameraInfo")}


def test_a_type_that_is_no_default_comes_on_request():
    routes = routed({"routes": [{"cortex": "*/rgb", "type": "sensor_msgs/CompressedImage"}]})
    assert routes["/drone/rgb", "CompressedImage"].ros_topic == "/drone/rgb/image_raw/compressed"
    assert ("/drone/rgb", "Image") in routes


def test_what_cannot_be_is_said_and_the_rest_goes_on():
    @message(name="lab/Sonar")
    class Sonar:
        range_m: float

    seen = Seen(
        (
            topic("/2/imu", Imu),
            topic("/drone/delivery", Delivery),
            topic("/drone/gps", Imu, fingerprint=1),
            topic("/drone/imu", Imu),
            topic("/drone/sonar", Sonar),
        )
    )
    settings = {
        "routes": [
            {"cortex": "/drone/imu", "type": "sensor_msgs/Image"},
            {"cortex": "/drone/imu", "type": "sensor_msgs/LaserScan"},
        ]
    }
    routes, problems = make_routes(seen, load(settings))
    assert table(routes) == {("/drone/imu -> /drone/imu", "sensor_msgs/Imu")}
    text = "\n".join(problems)
    for part in (
        "no route for /drone/sonar: nothing converts its type lab/Sonar",
        "/drone/gps: its cortex/Imu is of another version (0000000000000001)",
        "no route /2/imu -> /2/imu (sensor_msgs/msg/Imu): ROS allows no such name",
        "/drone/imu is a cortex/Imu, which does not become a sensor_msgs/msg/Image, but: sensor_msgs/msg/Imu",
        "nothing converts to or from sensor_msgs/msg/LaserScan, known: actuator_msgs",
    ):
        assert part in text
    assert len(problems) == 5


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"cortex": "/drone/rgb", "ros": "/drone/imu"}, "with type sensor_msgs/msg/Imu"),
        ({"cortex": "/drone/rotor_speeds", "ros": "/drone/actuators"}, "goes the other way"),
        ({"cortex": "/drone/gyro", "ros": "/drone/imu"}, "rename one of them"),
        ({"cortex": "/drone/rgb/transform", "qos": {"depth": 9}}, "another quality of service"),
    ],
)
def test_two_routes_that_do_not_go_together(change, reason):
    """A circle, two types or two sensors on one topic: the second is left out, and said."""
    seen = Seen((topic("/drone/gyro", Imu), *DRONE.topics))
    routes, problems = make_routes(seen, load({"routes": [change]}))
    assert len(problems) == 1
    assert reason in problems[0]
    assert len(routes) == len(default_routes(seen)) - 1


@pytest.mark.parametrize(
    ("settings", "message_"),
    [
        ({"namespce": "/a"}, "unknown key 'namespce', known: backend, .*did you mean 'namespace'"),
        ({"namespace": "/a b"}, "namespace must be a ROS name such as '/drone/imu'.* got '/a b'"),
        ({"routes": {"cortex": "/a"}}, "routes must be a list"),
        ({"routes": [{"ros": "/a"}]}, r"routes\[0\].cortex is missing"),
        ({"routes": [{"cortex": "imu"}]}, r"routes\[0\].cortex must be a Cortex topic .* got 'imu'"),
        ({"routes": [{"cortex": "/a", "type": "Imu"}]}, r"routes\[0\].type must be a ROS type .* got 'Imu'"),
        ({"routes": [{"cortex": "/*/a", "ros": "/b"}]}, r"must contain \{topic\}, got '/b'"),
        ({"routes": [{"cortex": "/a", "ros": "/b-c"}]}, r"routes\[0\].ros must be a ROS name"),
        ({"routes": [{"cortex": "/a", "qos": "fast"}]}, "unknown quality of service 'fast', known: default"),
        (
            {"routes": [{"cortex": "/a", "qos": {"depth": 0}}]},
            r"routes\[0\].qos.depth: .* greater than or equal to 1, got 0",
        ),
        (
            {"routes": [{"cortex": "/a", "qos": {"reliability": "yes"}}]},
            "'reliable' or 'best_effort', got 'yes'",
        ),
        ({"routes": [{"cortex": "/a", "enabled": "no"}]}, r"enabled must be true or false, got 'no'"),
        ({"rename": {"/drone": "quad"}}, "rename./drone must be a ROS name"),
        ({"rename": {"drone": "/quad"}}, "rename.drone must be a ROS name"),
        ({"converters": [""]}, r"converters\[0\]: .* at least 1 character"),
        ({"ros": {}}, "unknown key 'ros', known: backend, .*did you mean 'routes'"),
        ({"domain": -1}, "cortex_domain: .* greater than or equal to 0, got -1"),
        ({"cortex_domain": True}, "cortex_domain: .* valid integer, got True"),
        ({"distro": "hydro"}, "distro must be one of humble, .*, got 'hydro'"),
        ({"node": "my node"}, "node: invalid ROS name"),
        ({"frames": {"prefx": "x"}}, "frames: unknown key 'prefx', known: .*did you mean 'prefix'"),
        ({"frames": {"map": "two words"}}, "frames.map must be a name"),
        (
            {"routes": [{"cortex": "/a", "options": {"max_thrust": 20}}]},
            r"routes\[0\].options: unknown key 'max_thrust', .*did you mean 'max_thrust_n'",
        ),
        (
            {"routes": [{"cortex": "/a", "options": {"encoding": "evt2"}}]},
            r"routes\[0\].options: option encoding must be evt3 or mono, got 'evt2'",
        ),
        ({"include": ["drone"]}, r"include\[0\] must be a Cortex topic"),
        ([1], "the settings must be a mapping"),
    ],
)
def test_wrong_settings_are_refused_with_their_name(settings, message_):
    with pytest.raises(ConfigError, match=message_):
        load(settings)


def test_the_old_name_of_the_domain_of_cortex_works():
    assert load({"domain": 7}) == load({"cortex_domain": 7})


def test_an_option_that_no_route_of_its_entry_has_is_a_problem():
    """One that some of them have is for those."""
    settings = {"routes": [{"cortex": "/drone/imu", "options": {"encoding": "evt3", "queue": 9}}]}
    (problem,) = make_routes(DRONE, load(settings))[1]
    assert problem == (
        "routes[0].options: no route of /drone/imu has the option 'encoding', "
        "known: angular_velocity_std_rad_s, linear_acceleration_std_m_s2, queue"
    )
    settings = {"routes": [{"cortex": "/drone/*", "options": {"encoding": "mono", "stale_s": 1}}]}
    assert make_routes(DRONE, load(settings))[1] == []


def test_entries_that_fit_nothing_are_said():
    entries = [{"cortex": "/dron/imu"}, {"cortex": "/drone/command/ratse"}, {"cortex": "/drone/*"}]
    assert unfit(DRONE, load({"routes": entries})) == [
        "routes[0]: no Cortex topic fits /dron/imu, did you mean /drone/imu?",
        "routes[1]: no Cortex topic fits /drone/command/ratse, did you mean /drone/command/rates?",
    ]


def test_depth_becomes_a_cloud_on_request():
    entry = {"cortex": "/drone/rgb", "type": "sensor_msgs/PointCloud2", "options": {"depth_max_m": 5.0}}
    assert routed({"routes": [entry]})["/drone/rgb", "PointCloud2"].ros_topic == "/drone/rgb/points"


def test_a_settings_file_is_named_in_its_errors(tmp_path):
    path = tmp_path / "bridge.yaml"
    path.write_text("namespace: /neurosim\nroutes:\n  - cortex: /drone/rgb\n    qos: sensor_data\n")
    assert load(path).namespace == "/neurosim"
    path.write_text("routes: [\n")
    with pytest.raises(ConfigError, match=r"bridge\.yaml is not YAML"):
        load(path)
    path.write_text("a: 1\n")
    with pytest.raises(ConfigError, match=r"bridge\.yaml: unknown key 'a'"):
        load(path)
    with pytest.raises(ConfigError, match=r"cannot read .*nothing\.yaml: No such file"):
        load(tmp_path / "nothing.yaml")
    path.write_text("")
    assert load(path) == load(None)


@pytest.mark.parametrize(
    ("name", "vehicle"),
    [
        ("/drone/imu", "drone"),
        ("/drone/rgb/info", "drone"),
        ("/fleet/a/rgb/transform", "fleet/a"),
        ("/drone/command/rates", "drone"),
        ("/imu", ""),
    ],
)
def test_whose_topic_it_is(name, vehicle):
    assert vehicle_of(name) == vehicle


def test_discovery_shows_topics_and_services(runtime):
    """What others have, not what we have; commands as they are subscribed to, services by their types."""
    with Node("simulator") as simulator, Node("bridge") as node:
        simulator.publisher("/drone/odometry", Odometry, latch=True)
        simulator.publisher("/drone/imu", Imu)
        simulator.subscriber("/drone/command/rates", RateThrustCommand)
        simulator.subscriber("/drone/any", None)
        simulator.service("/reset", Reset, SimulatorReply, lambda _: None)
        simulator.service("/step", Step, SimulatorReply, lambda _: None)
        simulator.service("/other", Trigger, Trigger, lambda _: None)
        node.publisher("/ours", Imu)
        wait_for(lambda: len(look(node).topics) == 3 and len(look(node).services) == 2)
        seen = look(node)
    assert [(t.topic, t.published, t.latched) for t in seen.topics] == [
        ("/drone/command/rates", False, False),
        ("/drone/imu", True, False),
        ("/drone/odometry", True, True),
    ]
    assert seen.services == (("/reset", "cortex/Reset"), ("/step", "cortex/Step"))


README = FilePath(__file__).resolve().parents[2] / "cortex_ros2_bridge" / "README.md"


def example(name):
    """The code block of README.md that follows its mark."""
    text = README.read_text().partition(f"<!-- example: {name} -->")[2]
    return text.split("```")[1].partition("\n")[2]


def test_settings_of_the_readme():
    """They load, every entry changes something, and names come out as the comments say."""
    settings = yaml.safe_load(example("settings"))
    routes = routed(settings)
    assert routes["/drone/rgb", "Image"].ros_topic == "/neurosim/front/image_raw"
    assert routes["/drone/imu", "Imu"].ros_topic == "/neurosim/imu/data_raw"
    assert routes["/drone/imu", "Imu"].qos == config.QOS["sensor_data"]
    assert routes["/drone/events", "EventPacket"].options == {"encoding": "mono"}
    assert ("/drone/rgb", "CompressedImage") in routes
    assert routes["/drone/command/rates", "AttitudeTarget"].options["max_thrust_n"] == 20.0
    assert ("/drone/odometry", "TFMessage") not in routes


def test_names_of_the_readme():
    """Every ROS topic of the table is one that a default route has, and the other way round."""
    table_text = README.read_text().partition("## Routes")[2].partition("## Your own types")[0]
    named = set(re.findall(r"`(/[a-z_/]+)`", table_text))
    for route in default_routes(DRONE):
        if route.direction == "call" or "transform" in route.cortex_topic or "/info" in route.cortex_topic:
            continue
        assert route.ros_topic in named


def test_messages_of_the_readme(capsys):
    exec(compile(example("messages"), str(README), "exec"), {})
    assert capsys.readouterr().out == "9.81\n"
