"""Mount, lens and light that episodes draw: they are what flies, from the seed of the episode alone."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import neurosim_core as ns

torch = pytest.importorskip("torch", reason="needs the extra learn")

from neurosim_core.frames import Mount  # noqa: E402
from neurosim_core.learn.cameras import draw_lenses  # noqa: E402
from neurosim_core.learn.env import CAMERA  # noqa: E402
from neurosim_core.learn.randomisation import NO_RANDOMISATION  # noqa: E402
from neurosim_core.learn.tasks.hover import Hover  # noqa: E402
from neurosim_core.render.camera import PinholeConfig  # noqa: E402

torch.set_num_threads(1)

DRAWN = dataclasses.replace(
    NO_RANDOMISATION,
    mount_m=0.05,
    mount_rad=0.2,
    focal_factor=(0.8, 1.2),
    axis_shift=0.05,
    distortion=(-0.05, 0.05),
    light_factor=(0.02, 0.5),
)
NAMES = ("mount_m", "mount_rad", "focal_factor", "axis_shift", "distortion", "light_factor")


class Brief(Hover):
    """Hover with small pictures and short episodes; commands are kept."""

    camera = {"width": 16, "height": 16, "horizontal_fov_rad": 1.5}  # noqa: RUF012
    episode_s = 0.3

    def command(self, view):
        self.commands = super().command(view)
        return self.commands


@pytest.fixture
def make(hall):
    def make_env(worlds: int = 3, drawn=DRAWN, **options):
        return ns.learn.make_env(
            Brief(), worlds=worlds, device="cpu", models=[hall], randomise=drawn, **options
        )

    return make_env


def actions_of(steps: int, worlds: int) -> torch.Tensor:
    return 0.5 * torch.randn((steps, worlds, 4), generator=torch.Generator().manual_seed(5))


def events_of(observation, world: int) -> np.ndarray:
    """Return the events of a world, a row each, in order."""
    rows = np.stack(observation.events[CAMERA].numpy(world), axis=1)
    return rows[np.lexsort(rows.T)]


def alone(env, hall, world: int, **pictures):
    """Return a simulator of one world whose settings are what a world of an environment drew."""
    task, drawn = env.task, {name: value[world].numpy() for name, value in env.parameters.items()}
    lens = draw_lenses(task.camera, env.randomisation)[0][int(env.sim.optics(CAMERA)[2].numpy()[world])]
    assert lens.intrinsics().fx == pytest.approx(drawn["focal_factor"] * 8.0 / np.tan(0.75))
    assert lens.intrinsics().cx == pytest.approx(8.0 + 16.0 * drawn["axis_shift"][0])
    assert lens.distortion[0] == pytest.approx(drawn["distortion"])
    mount = Mount(**task.mount)
    turned = Rotation.from_rotvec(drawn["mount_rad"].astype(float)) * mount.rotation()
    placed = {
        "lens": lens.model_dump(),
        "mount": {
            "position_m": np.add(mount.position_m, drawn["mount_m"].astype(float)),
            "rpy_rad": turned.as_euler("ZYX")[::-1],
        },
    }
    return ns.Simulation(
        {
            "device": "cpu",
            "control": {"rate_hz": task.rate_hz},
            "render": {
                "samples_per_pixel": 4,
                "dark_floor": 1e-3 / float(drawn["light_factor"]),
                "exposure": env.sim.model.scene_on_device.exposure * float(drawn["light_factor"]),
            },
            "scene": hall.config.scene.model_dump(),
            "path": {"kind": "hover"},
            "vehicle": {"max_step_s": 0.004, **task.vehicle},
            "sensors": {
                **{name: {**picture, **placed} for name, picture in pictures.items()},
                CAMERA: {
                    "kind": "event_camera",
                    **placed,
                    "sampling_rate_hz": task.rate_hz,
                    "packet_rate_hz": task.rate_hz,
                    "pixel": {"threshold_on": task.threshold, "threshold_off": task.threshold},
                },
            },
        },
        event_capacity=8 * 16 * 16,
    )


def test_an_episode_sees_what_a_simulator_with_its_parameters_sees(make, hall):
    """Its mount, lens and light are settings there; a second episode has others."""
    env = make()
    env.reset(seed=1)
    actions = actions_of(25, 3)
    for episode in range(2):
        state = env.observation.state
        start = {n: getattr(state, n).numpy() for n in ("position", "velocity", "orientation", "body_rate")}
        world = episode  # of the first episode the first
        sim = alone(env, hall, world)
        sim.reset(**{name: rows[world] for name, rows in start.items()})
        count = 0
        for action in actions[:6]:
            env.step(action)
            observation = sim.step(env.task.commands[world : world + 1].numpy())
            seen, expected = events_of(env.observation, world), events_of(observation, 0)
            np.testing.assert_array_equal(seen[:, 1:], expected[:, 1:])
            np.testing.assert_allclose(seen[:, 0], expected[:, 0], rtol=0, atol=1)  # [us]: Euler angles
            count += len(seen)
        assert count > 100
        first = env.parameters
        for action in actions[6:15]:
            env.step(action)
        second = env.parameters
        assert all((second[name] != first[name]).any() for name in NAMES)


def test_pictures_that_share_its_rays_have_its_lens_mount_and_light(make, hall):
    kinds = ("depth", "optical_flow", "rgb")
    pictures = {kind: {"kind": kind, "rate_hz": 50.0} for kind in kinds}
    placed = {"lens": Brief.camera, "mount": Brief.mount}
    env = make(sensors={name: {**picture, **placed} for name, picture in pictures.items()})
    env.reset(seed=1)
    state = env.observation.state
    start = {n: getattr(state, n).numpy() for n in ("position", "velocity", "orientation", "body_rate")}
    sim = alone(env, hall, 2, **pictures)
    sim.reset(**{name: rows[2] for name, rows in start.items()})
    for action in actions_of(3, 3):
        env.step(action)
        observation = sim.step(env.task.commands[2:].numpy())
        for kind in kinds:
            seen, expected = (each.images[kind].numpy() for each in (env.observation, observation))
            assert np.ptp(seen[2]) > 0.1
            tolerance = 1.0 if kind == "rgb" else 1e-5  # a level; factors in float32
            np.testing.assert_allclose(seen[2].astype(float), expected[0], rtol=0.0, atol=tolerance)


def roll(env, steps: int = 20, **begin):
    """Return the surfaces of all steps and the parameters at the end."""
    observations, _ = env.reset(**begin)
    rows = [observations["events"].clone()]
    for action in actions_of(steps, 3)[:, : env.num_envs]:
        observations, *_ = env.step(action)
        rows.append(observations["events"].clone())
    return torch.stack(rows), env.parameters


def test_the_same_seed_draws_the_same_whatever_the_neighbours_are(make):
    env = make()
    first, drawn = roll(env, seed=4)
    again, same = roll(env, seed=4)
    lonely, own = roll(make(1), seed=4)
    torch.testing.assert_close(again, first, rtol=0.0, atol=0.0)
    torch.testing.assert_close(lonely[:, :1], first[:, :1], rtol=0.0, atol=0.0)
    for name, value in drawn.items():
        assert torch.equal(value, same[name])
        assert torch.equal(value[:1], own[name])


def test_episodes_are_played_again_by_their_seeds(make):
    env = make()
    env.reset(seed=4)
    for action in actions_of(18, 3):  # a second episode has begun
        *_, info = env.step(action)
    drawn = env.parameters
    other = make()
    played, found = roll(other, 3, episodes=info["seed"])
    torch.testing.assert_close(found, drawn, rtol=0.0, atol=0.0)
    again, _ = roll(env, 3, episodes=info["seed"])
    assert torch.equal(again, played)
    assert not torch.equal(roll(env, 3, seed=4)[0], played)


def test_without_draws_nothing_is_made_for_them(make):
    env = make(drawn=NO_RANDOMISATION)
    assert not env.sim.optics(CAMERA)[2].numpy().any()
    assert "light_factor" not in env.parameters
    with pytest.raises(ValueError, match="make them with per_world_light=True"):
        env.sim.light("exposure")


def test_a_range_of_one_value_is_drawn_too(make):
    env = make(drawn=dataclasses.replace(NO_RANDOMISATION, focal_factor=(1.2, 1.2), light_factor=(0.1, 0.1)))
    env.reset(seed=1)
    assert (env.parameters["focal_factor"] == np.float32(1.2)).all()
    found = draw_lenses(env.task.camera, env.randomisation)[0][0]
    assert found.intrinsics().fx == pytest.approx(1.2 * 8.0 / np.tan(0.75))
    assert env.sim.optics(CAMERA)[2].numpy().any()
    np.testing.assert_allclose(env.sim.light("dark_floor").numpy(), 1e-2, rtol=1e-5)


def test_lenses_that_cannot_be_drawn_are_said(make):
    fisheye = {"kind": "equidistant", "width": 16, "height": 16, "fx": 8, "fy": 8, "cx": 8, "cy": 8}
    with pytest.raises(ValueError, match="cannot draw lenses like one of kind 'equidistant', only pinhole"):
        draw_lenses(fisheye, DRAWN)
    with pytest.raises(ValueError, match="the polynomial folds over before the border"):
        make(drawn=dataclasses.replace(DRAWN, distortion=(-0.3, -0.2)))
    lens = {"width": 8, "height": 8, "horizontal_fov_rad": 1.5}
    config = {"sensors": {"front": {"kind": "event_camera", "lens": lens}}}
    other = PinholeConfig(width=4, height=8, horizontal_fov_rad=1.5)
    with pytest.raises(ValueError, match=r"lenses of 'front': give at least one, all of 8 x 8 px"):
        ns.Simulation(config, lenses={"front": [other]})
