"""SAC in plain PyTorch, with a plain policy or a rewired one, as a user would write it.

The rewired policy builds the straight-through SoftSort matrix where its gradient is
needed, and permutes by indices elsewhere. It does what `rewire_jax` does in a second
task: modes, their distillation, and the alignment with previous weights.
"""

import copy
import itertools
from typing import Any

import jax
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from experiments.speed.timing import Loop
from experiments.speed.vector import Vector
from rewire_jax.core.settings import Settings
from rewire_jax.core.transition import Batch
from rewire_jax.envs.base import Environment, Task

Transitions = tuple[Tensor, ...]
"""Observations, actions, rewards, ends, next observations."""
Gaussian = tuple[Tensor, Tensor]


def layers(sizes: list[int]) -> nn.ModuleList:
    """Linear layers, without what comes between."""
    return nn.ModuleList(nn.Linear(*pair) for pair in itertools.pairwise(sizes))


def forward(modules: nn.ModuleList, x: Tensor) -> Tensor:
    """An MLP."""
    for layer in modules[:-1]:
        x = functional.leaky_relu(layer(x), 0.2)
    return modules[-1](x)


def split(output: Tensor) -> Gaussian:
    """Mean and log-std."""
    mean, log_std = output.chunk(2, dim=-1)
    return mean, log_std.clamp(-20, 2)


def soft_sort(scores: Tensor, tau: float) -> Tensor:
    """The straight-through permutation matrix `[n, n]` (Eq. 3, 4)."""
    ordered, order = scores.sort()
    soft = torch.softmax(-(ordered[:, None] - scores).abs() / tau, dim=-1)
    hard = functional.one_hot(order, len(scores)).to(soft.dtype)
    return hard + soft - soft.detach()


class Plain(nn.Module):
    """A plain policy."""

    def __init__(self, settings: Settings, observations: int, actions: int):
        """Its layers have PyTorch's own initial values."""
        super().__init__()
        hidden = [settings.sac.hidden] * settings.sac.depth
        self.layers = layers([observations, *hidden, 2 * actions])

    def forward(self, x: Tensor) -> Gaussian:
        """Of a batch of observations."""
        return split(forward(self.layers, x))

    def penalty(self, x: Tensor, gaussian: Gaussian) -> Tensor:
        """Nothing beside SAC's loss."""
        return torch.zeros(())


class Rewired(Plain):
    """A policy with several wirings of the same weights."""

    def __init__(self, settings: Settings, observations: int, actions: int):
        """Begins a second task: there are previous weights."""
        super().__init__(settings, observations, actions)
        self.options, sac = settings.options, settings.sac
        spread = torch.linspace(0, 1, sac.hidden)
        self.scores = nn.Parameter(spread.repeat(self.options.modes, sac.depth, 1))
        self.adapters = nn.Parameter(spread.repeat(sac.depth, 1))
        self.input_adapters = nn.Parameter(spread.repeat(sac.depth - 1, 1))
        self.previous = copy.deepcopy(self.layers[:-1]).requires_grad_(False)
        self.mode = 0

    def forward(self, x: Tensor) -> Gaussian:
        """By a mode drawn at random."""
        self.mode = int(torch.randint(self.options.modes, ()))
        return self.by_mode(x, self.mode)

    def by_mode(self, x: Tensor, mode: int) -> Gaussian:
        """By one of the wirings."""
        for layer, scores in zip(self.layers[:-1], self.scores[mode], strict=True):
            x = layer(x)
            if torch.is_grad_enabled():
                uniform = torch.rand_like(scores).clamp_min(1e-20)
                noise = -torch.log(-torch.log(uniform))
                scores = scores + self.options.noise * noise
                x = x @ soft_sort(scores, self.options.tau).T
            else:
                x = x[:, scores.argsort()]
            x = functional.leaky_relu(x, 0.2)
        return split(self.layers[-1](x))

    def penalty(self, x: Tensor, gaussian: Gaussian) -> Tensor:
        """Distillation from another mode, and the alignment."""
        options, (mean, log_std) = self.options, gaussian
        modes = options.modes
        other = (self.mode + int(torch.randint(1, modes, ()))) % modes
        with torch.no_grad():
            other_mean, other_log_std = self.by_mode(x, other)
        difference = (mean - other_mean.clamp(-20, 20)) ** 2
        difference = difference + (log_std - other_log_std) ** 2
        # On the published scale, of a sum over 512 states.
        distillation = 512 * difference.sum(dim=-1).mean()
        return options.alpha * distillation + options.beta * self.alignment()

    def alignment(self) -> Tensor:
        """The authors' form of Eq. 11."""
        total, tau = torch.zeros(()), self.options.adapter_tau
        outputs = [soft_sort(scores, tau) for scores in self.adapters]
        inputs = [None, *(soft_sort(scores, tau) for scores in self.input_adapters)]
        pairs = zip(self.layers[:-1], self.previous, outputs, inputs, strict=True)
        for layer, before, output, entry in pairs:
            weight = output.T @ before.weight
            if entry is not None:
                weight = weight @ entry
            bias = output.T @ before.bias
            total = total + (layer.weight**2).sum() - 2 * (weight * layer.weight).sum()
            total = total + (layer.bias**2).sum() - 2 * (bias * layer.bias).sum()
        return total


class Critics(nn.Module):
    """Two critics."""

    def __init__(self, settings: Settings, inputs: int):
        """Their layers have PyTorch's own initial values."""
        super().__init__()
        sizes = [inputs, *[settings.sac.hidden] * settings.sac.depth, 1]
        self.both = nn.ModuleList(layers(sizes) for _ in range(2))

    def forward(self, x: Tensor, action: Tensor) -> Tensor:
        """Both values, `[2, batch]`."""
        inputs = torch.cat([x, action], dim=-1)
        return torch.stack([forward(one, inputs).squeeze(-1) for one in self.both])


def sample(gaussian: Gaussian) -> tuple[Tensor, Tensor]:
    """An action and its log-density."""
    mean, log_std = gaussian
    normal = torch.distributions.Normal(mean, log_std.exp())
    before = normal.rsample()
    # log(1 - tanh(x)^2), as it stays finite.
    squash = 2 * (np.log(2) - before - functional.softplus(-2 * before))
    return before.tanh(), (normal.log_prob(before) - squash).sum(dim=-1)


class Learner:
    """SAC."""

    def __init__(self, settings: Settings, observations: int, actions: int):
        """Fresh networks and optimisers."""
        self.settings, self.sac = settings, settings.sac
        kind = Rewired if settings.method == "rewire" else Plain
        self.policy = kind(settings, observations, actions)
        self.critics = Critics(settings, observations + actions)
        self.target = copy.deepcopy(self.critics).requires_grad_(False)
        temperature = torch.tensor(self.sac.initial_temperature)
        self.log_temperature = temperature.log().requires_grad_()
        self.goal = -self.sac.target_multiplier * actions
        self.count = 0
        adam = torch.optim.Adam
        self.critic_optimizer = adam(self.critics.parameters(), self.sac.lr_critic)
        own = dict(self.policy.named_parameters())
        scores = own.pop("scores", None)
        groups: list[dict[str, object]] = [{"params": list(own.values())}]
        if scores is not None:
            rate = settings.options.modes * self.sac.lr_policy
            groups.append({"params": [scores], "lr": rate})
        self.policy_optimizer = adam(groups, self.sac.lr_policy)
        self.temperature_optimizer = adam(
            [self.log_temperature], self.sac.lr_temperature
        )

    def update(self, batch: Transitions) -> None:
        """One update, in its turn of policy and targets too."""
        x, action, reward, ended, following = batch
        temperature = self.log_temperature.detach().exp()
        with torch.no_grad():
            next_action, log_density = sample(self.policy(following))
            q = self.target(following, next_action).min(dim=0).values
            left = self.sac.discount * (1 - ended) * (q - temperature * log_density)
            target = self.sac.reward_scale * reward + left
        loss = ((self.critics(x, action) - target) ** 2).mean(dim=-1).sum()
        self.critic_optimizer.zero_grad()
        loss.backward()
        self.critic_optimizer.step()
        if self.count % self.sac.policy_delay == 0:
            self.update_policy(x, temperature)
        if self.count % self.sac.target_delay == 0:
            with torch.no_grad():
                pairs = (self.target.parameters(), self.critics.parameters())
                for slow, fast in zip(*pairs, strict=True):
                    slow.lerp_(fast, self.sac.target_rate)
        self.count += 1

    def update_policy(self, x: Tensor, temperature: Tensor) -> None:
        """Policy and temperature."""
        gaussian = self.policy(x)
        action, log_density = sample(gaussian)
        self.critics.requires_grad_(False)
        q = self.critics(x, action).min(dim=0).values
        self.critics.requires_grad_(True)
        loss = (temperature * log_density - q).mean()
        loss = loss + self.policy.penalty(x, gaussian)
        self.policy_optimizer.zero_grad()
        loss.backward()
        self.policy_optimizer.step()
        surplus = -(log_density.detach().mean() + self.goal)
        self.temperature_optimizer.zero_grad()
        (self.log_temperature.exp() * surplus).backward()
        self.temperature_optimizer.step()


class Buffer:
    """A ring of transitions."""

    def __init__(self, size: int, observations: int, actions: int):
        """An empty one."""
        widths = (observations,), (actions,), (), (), (observations,)
        self.columns = [torch.zeros(size, *width) for width in widths]
        self.size, self.added = size, 0

    def add(self, rows: Transitions) -> None:
        """Adds some."""
        places = (self.added + torch.arange(len(rows[0]))) % self.size
        for column, new in zip(self.columns, rows, strict=True):
            column[places] = new
        self.added += len(places)

    def sample(self, count: int) -> Transitions:
        """Some of them, each as likely."""
        places = torch.randint(min(self.added, self.size), (count,))
        return tuple(column[places] for column in self.columns)


def tensors(*arrays: Any) -> Transitions:
    """Float tensors of arrays."""
    return tuple(torch.tensor(array, dtype=torch.float32) for array in arrays)


def update_loop(
    settings: Settings, environment: Environment, task: Task, batches: Batch
) -> Loop:
    """All the given batches, once or more often."""
    learner = Learner(settings, environment.observation_size, environment.action_size)
    arrays = jax.tree.map(np.asarray, batches)
    columns = tensors(
        arrays.observation,
        arrays.action,
        arrays.reward,
        arrays.terminal,
        arrays.next_observation,
    )
    rows = list(zip(*columns, strict=True))

    def loop(count):
        for _ in range(count):
            for row in rows:
                learner.update(row)

    return loop


def whole_loop(settings: Settings, environment: Environment, task: Task) -> Loop:
    """Steps of all environments with all their updates, once these are under way."""
    sizes = environment.observation_size, environment.action_size
    learner = Learner(settings, *sizes)
    buffer = Buffer(settings.interactions, *sizes)
    vector = Vector(environment, task, settings.envs)

    def collect():
        before = vector.observation
        with torch.no_grad():
            action = sample(learner.policy(torch.tensor(before)))[0].numpy()
        step = vector.step(action)
        ended = step.terminal | step.truncated
        buffer.add(tensors(before, action, step.reward, ended, step.final_obs))

    def loop(count):
        for _ in range(count):
            collect()
            for _ in range(settings.updates):
                learner.update(buffer.sample(settings.sac.batch_size))

    for _ in range(settings.warmup // settings.envs):
        collect()
    return loop
