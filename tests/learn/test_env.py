"""What whoever writes a training loop relies on: episodes, seeds, isolation, memory."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import neurosim_core as ns

torch = pytest.importorskip("torch", reason="needs the extra learn")

from neurosim_core.learn.randomisation import Randomisation  # noqa: E402
from neurosim_core.learn.tasks.hover import Hover  # noqa: E402

torch.set_num_threads(1)


class Brief(Hover):
    """Hover with small pictures and short episodes."""

    camera = {"width": 8, "height": 8, "horizontal_fov_rad": 1.5}  # noqa: RUF012
    episode_s = 0.2


@pytest.fixture
def make(hall):
    def make_env(worlds: int = 3, task=None, **options):
        return ns.learn.make_env(task or Brief(), worlds=worlds, device="cpu", models=[hall], **options)

    return make_env


def actions_of(steps: int, worlds: int) -> torch.Tensor:
    return 0.5 * torch.randn((steps, worlds, 4), generator=torch.Generator().manual_seed(5))


def roll(env, actions: torch.Tensor, seed: int = 3):
    """Return all observations, rewards and flags, stacked, [step, N, ...]."""
    observations, _ = env.reset(seed=seed)
    rows = [{name: value.clone() for name, value in observations.items()}]
    flags = []
    for action in actions:
        observations, reward, terminated, truncated, _ = env.step(action)
        rows.append({name: value.clone() for name, value in observations.items()})
        flags.append(torch.stack([reward, terminated.float(), truncated.float()]))
    return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}, torch.stack(flags)


def test_the_same_seed_gives_the_same_episodes_whatever_was_flown_before(make):
    env = make()
    actions = actions_of(25, 3)
    first = roll(env, actions)
    roll(env, actions_of(7, 3).flip(0), seed=9)
    again, fresh = roll(env, actions), roll(make(), actions)
    assert first[1][:, 2].any()  # episodes were cut, and began anew
    assert first[0]["events"].abs().sum() > 10.0
    for other in (again, fresh):
        for name, value in first[0].items():
            assert torch.equal(value, other[0][name]), name
        assert torch.equal(first[1], other[1])
    assert not torch.equal(first[0]["state"], roll(env, actions, seed=4)[0]["state"])


def test_nothing_of_a_world_depends_on_its_neighbours(make):
    """World 1 of three is world 0 of one whose seed is the next, also where neighbours begin anew."""
    actions = actions_of(25, 3)
    actions[:, 0, 0] = -1.0  # a neighbour that falls
    together, flags = roll(make(task=type("Long", (Brief,), {"episode_s": 0.3})()), actions)
    alone, own = roll(make(1, task=type("Long", (Brief,), {"episode_s": 0.3})()), actions[:, 1:2], seed=4)
    for name, value in alone.items():
        assert torch.equal(value[:, 0], together[name][:, 1]), name
    assert torch.equal(own[:, :, 0], flags[:, :, 1])


class Fewer(Brief):
    """It shows a part of the surfaces."""

    def observe(self, view):
        return super().observe(view) | {"events": view.surface[:, 1:]}


@pytest.mark.parametrize("task", [Brief, Fewer])
def test_an_episode_that_is_cut_begins_anew_in_the_same_step(make, task):
    env = make(worlds=2, task=task())
    observations, _ = env.reset(seed=0)
    assert env.episode_steps == 10
    for step in range(10):
        observations, _, terminated, truncated, info = env.step(torch.zeros(2, 4))
        assert truncated.all() == (step == 9)
    assert not terminated.any()
    assert env.episode_length.tolist() == [0, 0]
    assert not observations["events"].any()
    assert info["final_obs"]["events"].any()
    assert not torch.equal(observations["state"], info["final_obs"]["state"])
    np.testing.assert_allclose(env.view.elapsed_s, 0.0)


def test_a_crash_terminates_and_is_no_time_out(make):
    env = make(worlds=2, task=type("Long", (Brief,), {"episode_s": 10.0})())
    env.reset(seed=0)
    fall = torch.tensor([[-1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    for _ in range(200):
        _, reward, terminated, truncated, info = env.step(fall)
        if terminated[0]:
            break
    assert terminated[0]
    assert not truncated[0]
    assert reward[0] < -5.0
    assert info["metrics"]["crash"][0] == 1.0
    assert info["metrics"]["success"][0] == 0.0


def test_observations_share_memory_with_the_simulator(make):
    env = make()
    observations, _ = env.reset()
    assert observations["events"].data_ptr() == env.view.surface.data_ptr()
    assert observations["events"].dtype == torch.float32


@pytest.mark.parametrize("dtype", ["float16", "uint8"])
def test_surfaces_come_in_the_type_that_is_asked_for(make, dtype):
    shown = ns.learn.Counts(dtype=dtype)
    (exact, _), (seen, _) = (
        roll(make(surface=each), actions_of(12, 3)) for each in (ns.learn.Counts(), shown)
    )
    assert seen["events"].dtype == getattr(torch, dtype)
    assert seen["events"].any()
    assert torch.equal(seen["events"].float(), exact["events"])  # also where episodes began anew


def test_a_rollout_goes_on_from_a_saved_state(make, tmp_path):
    """In the same environment and in another one, with all that is drawn, sensors, and a world that ended."""
    drawn = Randomisation(lag_s=(0.01, 0.05), latency_steps=2, mass_factor=(0.9, 1.1), wind_m_s=1.0)
    drawn = dataclasses.replace(drawn, mount_rad=0.1, focal_factor=(0.9, 1.1), light_factor=(0.02, 1.0))
    options = {"randomise": drawn, "sensors": {"imu": {"kind": "imu", "rate_hz": 100}}}
    actions = actions_of(25, 3)
    actions[:, 0, 0] = -1.0

    def go_on(env):
        rows = []
        for action in actions[13:]:
            observations, reward, terminated, truncated, _ = env.step(action)
            samples = env.observation.samples["imu"].arrays.values()
            imu = [torch.from_numpy(array.numpy().copy()) for array in samples if array.size]
            seen = [*observations.values(), *imu, reward, terminated, truncated]
            rows.append(torch.cat([each.flatten().double() for each in seen]))
        return torch.cat(rows)

    env = make(**options)
    env.reset(seed=3, spread=True)
    for action in actions[:13]:
        observations = env.step(action)[0]
    before = {name: value.clone() for name, value in observations.items()}
    torch.save(env.state_dict(), tmp_path / "state.pt")
    expected = go_on(env)
    for other in (env, make(**options, seed=8)):
        seen = other.load_state_dict(torch.load(tmp_path / "state.pt"))
        assert all(torch.equal(value, before[name]) for name, value in seen.items())
        assert torch.equal(go_on(other), expected)
    other.reset()
    assert not torch.equal(go_on(other)[:100], expected[:100])
    with pytest.raises(ValueError, match="another kind of environment"):
        make(worlds=2, **options).load_state_dict(torch.load(tmp_path / "state.pt"))


def test_a_state_is_taken_up_where_steps_differ_in_length(make):
    """By a nanosecond, at 30 Hz: an environment of one step has not had those of all lengths."""
    task = type("Thirty", (Brief,), {"rate_hz": 30.0})()
    actions = actions_of(8, 3)
    env, other = make(task=task), make(task=task)
    roll(env, actions[:4])
    other.load_state_dict(env.state_dict())
    for action in actions[4:]:
        expected, seen = env.step(action)[0], other.step(action)[0]
        assert all(torch.equal(seen[name], value) for name, value in expected.items())


def test_what_each_step_renders_is_not_saved(make):
    """Frames of all worlds are more than all the rest."""
    env = make()
    roll(env, actions_of(2, 3))
    assert not [path for path in env.state_dict() if path.endswith("._frames")]


def test_what_sensors_remember_elsewhere_is_not_saved(make):
    noisy = {"pixel": {"threshold_on": 0.2, "threshold_off": 0.2, "shot_noise": {"rate_hz": 5.0}}}
    env = make(task=type("Noisy", (Brief,), noisy)(), randomise=False)
    env.reset()
    with pytest.raises(ValueError, match="front: noise"):
        env.state_dict()


def test_a_step_with_endings_makes_no_tensor_of_host_numbers(make, host_tensors):
    drawn = Randomisation(lag_s=(0.01, 0.05), mass_factor=(0.9, 1.1), wind_m_s=1.0)
    env = make(randomise=drawn)
    env.reset(seed=1)
    actions = torch.zeros((3, 4))

    def step_and_end() -> None:
        env.episode_length.fill_(env.episode_steps - 1)
        *_, truncated, _ = env.step(actions)
        assert truncated.all()

    assert host_tensors(step_and_end) == 0
    assert host_tensors(lambda: torch.tensor(1.0)) == 1


def test_the_student_sees_neither_velocity_nor_position(make):
    """Two worlds that differ in nothing else look alike to it before the first event."""
    env = make(worlds=2, randomise=False)
    env.reset(seed=1)
    env.view.velocity_B[:] = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    env.view.gravity_measured[:], env.view.gyro[:] = 0.5, 0.25
    seen = env.task.observe(env.view) | {"events": env.view.surface}
    student = env.group(seen, "student")
    assert torch.equal(student[0], student[1])
    assert not torch.equal(*env.group(seen, "teacher"))


def test_starts_are_in_free_space_and_differ(make, hall):
    env = make(worlds=64)
    env.reset(seed=0)
    position = env.view.position.numpy()
    assert hall.free_space.clearance(position).min() > 0.85
    assert len(np.unique(position, axis=0)) > 32
    speed = env.view.velocity.norm(dim=1)
    assert speed.max() <= 1.4 + 1e-6
    assert speed.min() < 0.5
    np.testing.assert_allclose(env.view.clearance[:, 0], hall.free_space.clearance(position), atol=0.2)
    thresholds = env.sim.thresholds("front").numpy()
    assert thresholds.min() >= 0.08 - 1e-6
    assert thresholds.max() <= 0.125 + 1e-6
    assert np.ptp(thresholds) > 0.02


def test_without_events_nothing_is_rendered(make):
    env = make(observe=["state"])
    observations, _ = env.reset()
    assert set(observations) == {"state"}
    assert not env.sim.model.config.sensors


def test_an_unknown_task_is_said():
    with pytest.raises(ValueError, match=r"unknown task kind 'juggle', known: .*'hover'"):
        ns.learn.make_env("juggle")


def test_gymnasium(hall):
    gymnasium = pytest.importorskip("gymnasium")
    env = gymnasium.make_vec(
        "neurosim_core.learn.gym:neurosim/hover-v0", num_envs=2, device="cpu", models=[hall], group="actor"
    )
    observations, _ = env.reset(seed=1)
    assert env.observation_space.contains(observations)
    observations, reward, terminated, truncated, _ = env.step(env.action_space.sample())
    assert observations["state"].shape == (2, 17)
    assert {each.shape for each in (reward, terminated, truncated)} == {(2,)}
    env.close()


def test_gymnasium_plays_episodes_again(make):
    """With the seeds that a step told; what a reset cannot do is said."""
    pytest.importorskip("gymnasium")
    from neurosim_core.learn.gym import NumpyEnv

    env = NumpyEnv(make())
    _, begun = env.reset(seed=2)
    actions = actions_of(20, 3).numpy()
    for action in actions:
        *_, info = env.step(action)
    assert (info["seed"] != begun["seed"]).all()  # episodes of `Brief` are shorter
    assert not info["dropped"].any()
    first, _ = env.reset(seed=7)
    again, told = env.reset(options={"episodes": info["seed"]})
    np.testing.assert_array_equal(told["seed"], info["seed"])
    same, _ = NumpyEnv(make()).reset(options={"episodes": info["seed"]})
    for name, value in again.items():
        np.testing.assert_array_equal(same[name], value)
    assert not np.array_equal(first["state"], again["state"])
    with pytest.raises(ValueError, match=r"unknown options \['low'\], known: \['episodes', 'spread'\]"):
        env.reset(options={"low": 1})


def test_wrong_arguments_are_said(make):
    env = make(observe=["state"])
    env.reset()
    for shape in ((4,), (3, 3), (1, 4)):
        with pytest.raises(ValueError, match=r"actions must have shape \(3, 4\), got"):
            env.step(torch.zeros(shape))
    with pytest.raises(ValueError, match="seed must be 0 at least, got -1"):
        env.reset(seed=-1)
    with pytest.raises(TypeError):
        env.reset(seed=[1, 2, 3])
    for episodes in (torch.ones(3), torch.tensor(1)):
        with pytest.raises(ValueError, match=r"episodes must be int64 of shape \(3,\), got"):
            env.reset(episodes=episodes)


@pytest.mark.parametrize(
    ("drawn", "message"),
    [
        ({"light_factor": (0.0, 1.0)}, r"light_factor must be above 0, got \(0.0, 1.0\)"),
        ({"focal_factor": (1.1, 0.9)}, "focal_factor must be finite, not negative, and in order"),
        ({"mount_rad": -0.1}, "mount_rad must be finite, not negative, and in order, got -0.1"),
        ({"lag_s": (-0.1, 0.1)}, "lag_s must be"),
        ({"wind_m_s": float("nan")}, "wind_m_s must be"),
    ],
)
def test_what_cannot_be_drawn_is_said(drawn, message):
    ns.learn.Randomisation(drag_factor=(0.0, 1.0), distortion=(-0.2, -0.1))
    with pytest.raises(ValueError, match=message):
        ns.learn.Randomisation(**drawn)


def test_thresholds_are_drawn_about_those_of_the_pixels(make):
    """A task may set its pixels, ideal ones or with noise, which have no thresholds to draw."""
    task = Brief()
    task.pixel = {"threshold_on": 0.2, "threshold_off": 0.3}
    env = make(64, task, randomise=ns.learn.Randomisation(threshold_factor=(0.5, 0.9)))
    env.reset(seed=1)
    factor = env.parameters["threshold_factor"]
    assert 0.5 <= factor.min() < 0.6 < 0.8 < factor.max() <= 0.9
    expected = factor.double().numpy() * [0.2, 0.3]
    np.testing.assert_allclose(env.sim.thresholds("front").numpy(), expected, rtol=1e-6)
    task.pixel = {"preset": "davis346", "readout": None}
    env = make(1, task, randomise=still(mass_factor=(0.9, 1.1)))
    env.reset()
    assert env.parameters["mass_factor"] != 1.0


def still(**ranges):
    """Return a randomisation of airframes only."""
    return ns.learn.Randomisation(
        thrust_factor=(1.0, 1.0),
        latency_steps=0,
        threshold_factor=(1.0, 1.0),
        gyro_noise_rad_s=0.0,
        gravity_noise=0.0,
        **ranges,
    )


def calm(**start):
    """Return a task that begins at rest and level."""
    return type(
        "Calm", (Brief,), {"start": ns.learn.StartConfig(clearance_m=0.9, **start), "episode_s": 1.0}
    )()


def fly(make, action, steps, **settings):
    """Return an environment where an action was held for some steps, from rest, and nothing is drawn."""
    task = calm()
    for name, value in settings.items():
        setattr(task, name, value)
    env = make(4, task, observe=["state"], randomise=still())
    env.reset(seed=1)
    for _ in range(steps):
        env.step(torch.tensor(action).repeat(4, 1))
    return env


def test_actions_command_rotors(make):
    """Equal thrusts of 1 + a climb with a g; more on one side turns the vehicle."""
    view = fly(make, [0.5] * 4, 5, mode="motor_speeds", thrust_span=0.4).view
    # motors of 5 ms lag, inflow: 8 %
    torch.testing.assert_close(view.velocity[:, 2], torch.full((4,), 0.1 * 9.81 * 0.2), rtol=0.13, atol=0.0)
    assert view.velocity_B[:, :2].abs().max() < 1e-3
    assert fly(make, [0.0] * 4, 5, mode="motor_speeds").view.velocity.abs().max() < 1e-3
    left = [0.1 * (y > 0.0) for _, y, _ in view.vehicle.rotor_position_m]
    assert fly(make, left, 3, mode="motor_speeds").view.body_rate[:, 0].min() > 0.1


def test_actions_command_an_attitude(make):
    """Roll, pitch and heading are reached, whichever way the vehicle looks."""
    before = fly(make, [0.0] * 4, 0, mode="attitude").view
    q = before.orientation.clone()
    view = fly(make, [0.0, 0.5, -0.25, 0.0], 30, mode="attitude", tilt_max_rad=0.4).view
    roll, pitch = torch.tensor(0.2), torch.tensor(-0.1)
    down = torch.stack([pitch.sin(), -roll.sin() * pitch.cos(), -roll.cos() * pitch.cos()])
    torch.testing.assert_close(view.gravity_B, down.repeat(4, 1), atol=0.02, rtol=0.0)
    assert (view.orientation * q).sum(1).abs().min() > 0.98  # the heading stays
    view = fly(make, [0.0, 0.0, 0.0, 1.0], 10, mode="attitude").view
    assert view.body_rate[:, 2].min() > 0.1
    assert fly(make, [1.0, 0.0, 0.0, 0.0], 10, mode="attitude").view.velocity[:, 2].min() > 0.5


def test_attitudes_begin_and_go_on_with_the_heading(make):
    """A command that is late, or lags, is one of the same heading: no vehicle is turned aside."""
    task = calm()
    task.mode, task.tilt_max_rad, task.episode_s = "attitude", 0.4, 8.0
    late = dataclasses.replace(still(), latency_steps=3, lag_s=(0.05, 0.05))
    env = make(8, task, observe=["state"], randomise=late)
    env.reset(seed=1)
    env.step(torch.zeros(8, 4))
    assert env.view.body_rate.abs().max() < 1e-3
    turning = []
    for _ in range(120):  # more than a turn, so each passes +-180 degrees
        env.step(torch.tensor([0.0, 0.0, 0.0, 1.0]).repeat(8, 1))
        turning.append(env.view.body_rate.clone())
    settled = torch.stack(turning[30:])
    assert settled[..., 2].min() > 0.8 * settled[..., 2].max() > 0.5
    assert settled[..., :2].abs().max() < 0.05


def test_actions_command_a_velocity(make):
    """Ahead is where the vehicle looks; the thrust is not a command, and no factor of it counts."""
    view = fly(make, [0.5, 0.0, 0.25, 0.0], 40, mode="velocity", speed_max_m_s=1.0).view
    torch.testing.assert_close(
        view.velocity_B, torch.tensor([0.5, 0.0, 0.25]).repeat(4, 1), atol=0.06, rtol=0.0
    )
    assert fly(make, [0.0] * 4, 20, mode="velocity").view.velocity.abs().max() < 0.02
    with pytest.raises(ValueError, match="unknown mode 'position' of actions, known: rates, attitude"):
        fly(make, [0.0] * 4, 0, mode="position")


def test_a_mass_that_is_drawn_is_the_mass_that_flies(make):
    """The thrust that carries the nominal mass m accelerates f m with g (1 / f - 1) upwards."""
    env = make(
        8, calm(), observe=["state"], randomise=still(mass_factor=(0.7, 1.3), inertia_factor=(0.5, 2.0))
    )
    env.reset(seed=1)
    for _ in range(5):
        env.step(torch.zeros(8, 4))
    factor = env.parameters["mass_factor"]
    assert factor.min() > 0.7
    assert factor.max() < 1.3
    assert factor.std() > 0.05
    expected = 0.1 * 9.81 * (1.0 / factor - 1.0)
    # drag takes v t / 2 m = 0.02 v of the speed at most, and lift adds as much
    torch.testing.assert_close(env.view.velocity[:, 2], expected, rtol=0.05, atol=0.002)
    first = env.parameters
    env.reset(seed=1)
    assert all(torch.equal(value, first[name]) for name, value in env.parameters.items())
    env.reset(seed=2)
    assert not torch.equal(env.parameters["mass_factor"], factor)


def test_thrust_follows_its_command_with_the_lag_that_is_drawn(make):
    """After a step of a g in thrust the vehicle climbs with a g (t - tau (1 - exp(-t / tau)))."""
    task = calm()
    env = make(8, task, observe=["state"], randomise=still(lag_s=(0.02, 0.1)))
    for _ in range(2):  # the second episode does not go on from what lagged in the first
        env.reset(seed=1)
        for _ in range(10):
            env.step(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(8, 1))
        lag, time_s = env.parameters["lag_s"], 10 * env.view.step_s
        assert 0.02 <= lag.min() < lag.max() <= 0.1
        assert lag.std() > 0.005
        expected = 9.81 * task.thrust_span * (time_s - lag * (1.0 - torch.exp(-time_s / lag)))
        # inflow takes 0.9 v a second, which is 8 %, and the motors' own lag 5 ms of 110
        torch.testing.assert_close(env.view.velocity[:, 2], expected, rtol=0.13, atol=0.0)


def test_a_wind_that_is_drawn_blows_in_proportion_to_the_drag(make):
    """At rest and level the acceleration is k (v_wind - v) / m, with the drag k that is drawn."""
    env = make(8, calm(), observe=["state"], randomise=still(drag_factor=(0.5, 2.0), wind_m_s=1.0))
    env.reset(seed=1)
    for _ in range(5):
        env.step(torch.zeros(8, 4))
    found = env.parameters
    push = found["drag_factor"][:, None] * found["wind_m_s"]
    ratio = (env.view.velocity[:, :2] * push).sum(1) / push.square().sum(1)
    assert found["wind_m_s"].norm(dim=1).max() <= 1.0
    assert ratio.min() > 0.0
    # 0.1 s against a time constant m / k of 1.2 s or more, and the vehicle tilts a little
    assert ratio.max() < 1.15 * ratio.min()


def test_a_biased_gyroscope_is_wrong_by_the_same_in_each_step(make):
    env = make(4, calm(), observe=["state"], randomise=still(gyro_bias_rad_s=0.1))
    env.reset(seed=1)
    errors = []
    for _ in range(4):
        env.step(torch.zeros(4, 4))
        errors.append(env.view.gyro - env.view.body_rate)
    torch.testing.assert_close(torch.stack(errors), errors[0].expand(4, 4, 3), rtol=0.0, atol=1e-6)
    assert errors[0].abs().max() <= 0.1
    assert errors[0].std() > 0.02


def test_a_fast_turn_loses_no_events(make):
    changes = {"rate_max_rad_s": (4.0, 4.0, 4.0), "episode_s": 1.0, "threshold": 0.02}
    env = make(4, type("Turning", (Brief,), changes)())
    env.reset(seed=1)
    turn = torch.tensor([0.0, 0.0, 0.5, 1.0]).expand(4, 4)
    events = torch.zeros(())
    for _ in range(10):
        observations, *_, info = env.step(turn)
        assert not info["dropped"].any()
        events = torch.maximum(events, observations["events"][:, :2].sum((1, 2, 3)).max())
    assert events > 2 * 8 * 8  # more than worlds have room for by default


def test_the_rate_counts_steps_of_all_worlds(hall):
    """Episodes are cut where that is asked for only, and as many as that in each step."""
    from neurosim_core.learn.rate import measure_steps, measure_updates

    env = ns.learn.make_env("hover", worlds=8, device="cpu", pixels=8, models=[hall])
    cut = 0
    step = env.step

    def counted(actions):
        nonlocal cut
        result = step(actions)
        cut += int(result[3].sum())
        return result

    env.step = counted
    rate, least, most = measure_steps(env, seconds=0.1)
    assert 0.0 < least <= rate <= most
    assert cut == 0
    measure_steps(env, ending=2, seconds=0.1)
    assert cut >= 2 * (5 + 3 + 5)
    rate, least, most = measure_updates(env)
    assert 0.0 < least <= rate <= most
