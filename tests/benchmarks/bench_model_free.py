"""PPO on nav beside Stable-Baselines3's own over the same single environments; nothing is asserted.

OMP_NUM_THREADS=1 python -m pytest tests/benchmarks/bench_model_free.py -s

Ours is the learner as a worker runs it, with the environment's ledger and pulses. The peer is the
same PPO with the same network, rollout, minibatches and number of updates on a ``DummyVecEnv`` of
``gymnasium.make`` environments. Both are timed in turn, a few rollouts each, so that a busy machine
slows both down.
"""

import math
import os
import platform
import statistics
import time
from pathlib import Path

import gymnasium
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from solar_cli.envs import build_task
from solar_cli.envs.front_ends import IDS
from solar_cli.envs.stable_baselines import BatchedVecEnv
from solar_cli.experience import Environment, Experience
from solar_cli.methods.on_policy import evaluated_after
from solar_cli.methods.ppo import Ppo
from solar_cli.settings import load_card, resolve
from solar_cli.streams import Streams

ROUNDS, ROLLOUTS = 6, 4


def hardware():
    """One line that says what a figure was measured on."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    model = next((line.split(": ")[1] for line in lines if line.startswith("model name")), "")
    return (
        f"{model or platform.processor()}, {os.cpu_count()} cores, 1 thread, "
        f"Python {platform.python_version()}, torch {torch.__version__}"
    )


def ours(configuration, folder):
    """A few more rollouts of ours at every call."""
    task, streams = configuration.task, Streams(0)
    environment = Environment(build_task(task), task, streams.under("environment"), folder)
    learner = Ppo(configuration.method, task, streams.under("learner"), "cpu", lambda *_: None)

    def go_on():
        for _ in range(ROLLOUTS):
            # Early iterations are one rollout each; what an iteration is costs nothing here.
            learner.rollouts = evaluated_after(environment.iteration, learner.settings.evaluations)
            environment.begin(environment.iteration + 1)
            learner.iterate(Experience(environment))
            environment.iteration %= 8

    return go_on


class Flat(BaseFeaturesExtractor):
    """The card's layers as anybody would write them."""

    def __init__(self, space, width):
        super().__init__(space, width)
        linear = nn.Linear(math.prod(space.shape), width)
        self.layers = nn.Sequential(nn.Flatten(), linear, nn.ReLU())

    def forward(self, observations):
        return self.layers(observations)


def peer(configuration, env):
    """The same number of rollouts of Stable-Baselines3's."""
    settings = configuration.method
    heads, [layer] = list(settings.network.heads), settings.network.layers
    model = PPO(
        ActorCriticPolicy,
        env,
        learning_rate=settings.learning_rate,
        n_steps=configuration.task.horizon,
        batch_size=settings.minibatch,
        n_epochs=settings.epochs,
        gamma=settings.discount,
        gae_lambda=settings.gae_lambda,
        policy_kwargs=dict(
            net_arch=dict(pi=heads, vf=heads),
            log_std_init=math.log(settings.network.std),
            features_extractor_class=Flat,
            features_extractor_kwargs=dict(width=layer.width),
            share_features_extractor=settings.network.shared,
        ),
        device="cpu",
    )
    # Its own logger leaves a folder in the temporary directory.
    model.set_logger(Logger(folder=None, output_formats=[]))
    steps = ROLLOUTS * settings.rollout * configuration.task.horizon
    return lambda: model.learn(steps)


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_ppo_on_nav(tmp_path):
    torch.set_num_threads(1)
    sets = ['methods.ppo.stop_kl="never"']  # else both stop where they like
    configuration = resolve(load_card("nav"), "ppo", sets=sets).configuration
    rows = configuration.method.rollout
    name = next(name for name, card in IDS.items() if card == "nav")
    loop = DummyVecEnv([lambda: gymnasium.make(name)] * rows)
    runs = [
        ours(configuration, tmp_path),
        peer(configuration, loop),
        peer(configuration, BatchedVecEnv("nav", rows)),
    ]
    seconds = [[], [], []]
    for _ in range(ROUNDS):
        for run, taken in zip(runs, seconds, strict=True):
            began = time.process_time()
            run()
            taken.append(time.process_time() - began)
    steps = ROLLOUTS * rows * configuration.task.horizon
    speed = [steps / statistics.median(taken[1:]) for taken in seconds]
    own = seconds[0][1:]
    ratios = [sorted(b / a for a, b in zip(own, one[1:], strict=True)) for one in seconds]
    print(
        f"\n{hardware()}\nnav, PPO: "
        f"{speed[0]:,.0f} steps/s; Stable-Baselines3 on DummyVecEnv {speed[1]:,.0f}: "
        f"{statistics.median(ratios[1]):.2f} times ({ratios[1][0]:.2f} to {ratios[1][-1]:.2f}); "
        f"on our vector environment {speed[2]:,.0f}: {statistics.median(ratios[2]):.2f} times "
        f"(CPU time, median of {ROUNDS - 1} rounds)"
    )
