"""The assembly check: every planted mistake has its own message, the one that docs/pages/swap/errors.md shows."""

import subprocess
import sys

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.modules import DistributionalQValueActor
from torchrl.objectives import DistributionalDQNLoss

from pgkit import data, envs, losses, modules, updates
from pgkit.checks import LossView, assembly
from pgkit.compiled import undone
from pgkit.errors import UserError
from tests.updates.mistakes import MISTAKES, PAGE, Agent, ReplayAgent, message, page, section


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.__name__)
def test_a_planted_mistake_is_found_and_documented(mistake):
    text = message(mistake)
    assert "\n" not in text
    assert section(mistake) in PAGE.read_text(), "run python -m tests.updates.mistakes"


def test_the_page_is_complete_and_every_message_different():
    text = PAGE.read_text()
    assert text == page(), "run python -m tests.updates.mistakes"
    errors = [line for line in text.splitlines() if line.startswith("error: ")]
    assert len(set(errors)) == len(MISTAKES) >= 15


def test_what_is_right_passes_and_leaves_no_trace():
    for agent in (Agent(), Agent("CartPole-v1"), ReplayAgent()):
        agent.train()
    agent = Agent()
    agent.loss.register_buffer("calls", torch.zeros(()))
    stock, seen = agent.loss.forward, []

    def counting(batch):
        agent.loss.calls += 1
        seen.append(torch.rand(()))
        return stock(batch)

    agent.loss.forward = counting
    state = torch.get_rng_state()
    batch = agent.advantage(agent.rollout).reshape(-1)[:32]
    view, optimizer = LossView(agent.loss, agent.advantage), torch.optim.Adam(agent.parameters)
    names = undone(agent.loss.buffers(), lambda: assembly(view, optimizer, batch))  # as updates do
    assert names[:2] == ["loss_objective", "loss_entropy"]
    assert len(seen) == 1 and agent.loss.calls == 0 and torch.equal(state, torch.get_rng_state())


def test_an_error_of_the_loss_itself_is_not_dressed_up():
    agent = Agent()

    def surrogate(log_ratio, advantage):
        raise RuntimeError("my own bug")

    agent.loss = losses.ClipPPOLoss(agent.actor, agent.critic, surrogate=surrogate)
    with pytest.raises(RuntimeError, match="^my own bug$"):
        agent.train()


def test_a_frozen_critic_of_the_advantage_block_is_accepted():
    agent = Agent()
    frozen = modules.state_value(agent.env, hidden=(8,)).requires_grad_(False)
    agent.advantage.critic = frozen
    agent.train()


def test_the_diagram_names_blocks_entries_and_then_shapes():
    agent = Agent()
    update = updates.OnPolicyUpdate(agent.loss, agent.advantage, torch.optim.Adam(agent.parameters), compile="off")
    rows = {line.split()[0]: line.split()[1:] for line in str(update).splitlines() if line.startswith("  ")}
    assert rows["advantage"] == ["GAE", "ClipPPOLoss"] and rows["action"] == ["actor_network", "ClipPPOLoss"]
    assert rows["next.reward"] == ["environment", "GAE"] and rows["entry"][0] == "written"
    assert "107 parameters" not in str(update) and "GAE, gamma 0.99, lmbda 0.95" in str(update)
    update(agent.rollout)
    assert "  advantage         (64, 1)  GAE" in str(update)


def test_the_diagram_of_a_replay_agent():
    agent = ReplayAgent()
    sizes = {"batch_size": 32, "learning_starts": 64}
    update = updates.OffPolicyUpdate(agent.loss, agent.buffer, torch.optim.Adam(agent.loss.parameters()), **sizes)
    text = str(update)
    assert "SACLoss, gamma 0.99" in text and "loss_actor + loss_qvalue + loss_alpha" in text and "ReplayBuffer" in text


def test_the_diagram_of_a_loss_that_names_no_in_keys():
    env = envs.make("CartPole-v1")
    net = TensorDictModule(lambda x: x, in_keys=["observation"], out_keys=["action_value"])
    actor = DistributionalQValueActor(net, support=torch.linspace(0, 1, 4), action_space="categorical")
    loss = DistributionalDQNLoss(actor, gamma=0.9)
    assert not hasattr(loss, "in_keys")
    text = str(updates.OffPolicyUpdate(loss, data.ReplayBuffer(env, 1000), torch.optim.Adam([torch.zeros(1)])))
    rows = [line.split()[0] for line in text.partition("entry")[2].splitlines()[1:]]
    after = ["next.observation", "next.reward", "next.done", "next.terminated"]
    assert rows == ["observation", "action", *after]


@pytest.mark.parametrize("recipe", ["ppo", "sac"])
def test_explain_prints_the_diagram_and_trains_nothing(recipe, tmp_path):
    flags = ["--env-id", "Pendulum-v1", "--explain", "--run-dir", str(tmp_path / "run")]
    done = subprocess.run([sys.executable, "-m", "pgkit", "run", recipe, *flags], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "written by" in done.stdout and "actor_network" in done.stdout and not (tmp_path / "run").exists()


def test_a_user_error_of_a_block_passes_as_it_is():
    agent = Agent()

    def forward(batch):
        raise UserError("turn the knob")

    agent.loss.forward = forward
    with pytest.raises(UserError, match="^turn the knob$"):
        agent.train()
