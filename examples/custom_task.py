"""Train your own task in one file: climb to a height above the start. It prints the final error.

python examples/custom_task.py            # a minute on a laptop; needs the extra `learn`
"""

from __future__ import annotations

import argparse

import neurosim_core as ns

try:
    import torch
except ImportError as error:
    raise SystemExit(f"this example needs PyTorch ({error}): pip install -e '.[learn]'") from None


@ns.register("task", "climb")
class Climb(ns.learn.Task):
    """Climb by 0.3 m to 0.6 m, as each episode draws, and stay there."""

    episode_s = 3.0
    start = ns.learn.StartConfig(clearance_m=0.8, tilt_max_rad=0.1)
    groups = {"actor": ("state",), "critic": ("state",), "teacher": ("state",)}  # noqa: RUF012

    def begin(self, view: ns.learn.View, mask: torch.Tensor) -> None:
        """Choose the height of each new episode."""
        if not hasattr(self, "goal_m"):
            self.goal_m = torch.zeros_like(view.elapsed_s)
        chosen = view.position[:, 2] + 0.3 + 0.3 * view.draws[:, 1]
        self.goal_m = torch.where(mask, chosen, self.goal_m)

    def observe(self, view: ns.learn.View) -> dict[str, torch.Tensor]:
        """Return the error in height, the velocity and the attitude."""
        error = (self.goal_m - view.position[:, 2])[:, None]
        return {
            "state": torch.cat([error, view.velocity_B, view.gravity_B, view.body_rate, view.action], dim=1)
        }

    def reward(self, view: ns.learn.View) -> torch.Tensor:
        """Pay for being near the height, and slow."""
        error = (self.goal_m - view.position[:, 2]).abs()
        cost = error + 0.2 * view.velocity.norm(dim=1) + 0.05 * view.body_rate.norm(dim=1)
        return 1.0 - cost - 10.0 * view.crashed

    def metrics(self, view: ns.learn.View) -> dict[str, torch.Tensor]:
        """Return the error at the end [m], and whether it is below 0.1 m."""
        error = (self.goal_m - view.position[:, 2]).abs()
        success = (error < 0.1) & ~view.crashed
        return {"error_m": error, "crash": view.crashed.float(), "success": success.float()}


def main(iterations: int) -> float:
    """Train, and return the mean error of the height at the end of an episode [m]."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    scene = {"kind": "apartment", "rooms": 1}
    env = ns.learn.make_env("climb", worlds=128, device="cpu", observe=["state"], scenes=[scene])
    ppo = ns.learn.Ppo(
        env, ns.learn.PpoConfig(worlds=128, iterations=iterations), torch.Generator().manual_seed(0)
    )
    ppo.begin(seed=1)
    for iteration in range(iterations):
        log = ppo.iterate(iteration / iterations)
        if iteration % 20 == 19:
            print(f"{iteration + 1}: reward {log['reward']:.2f}")
    found = ns.learn.evaluate_policy(env, ns.learn.teacher_actor(ppo.policy, env))
    print(f"{found}; {found.metrics['error_m']:.2f} m from the height")
    return found.metrics["error_m"]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=100)
    main(parser.parse_args().iterations)
