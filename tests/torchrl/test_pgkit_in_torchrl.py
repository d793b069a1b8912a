"""pgkit's losses, actors and environments in TorchRL's own Trainer, updaters, collectors and checks."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import TransformedEnv, check_env_specs
from torchrl.envs.transforms import Compose, RewardScaling, StepCounter
from torchrl.objectives import HardUpdate, SoftUpdate, group_optimizers
from torchrl.objectives.utils import ValueEstimators
from torchrl.objectives.value import GAE
from torchrl.trainers import BatchSubSampler, ReplayBufferTrainer, TargetNetUpdaterHook, Trainer

from pgkit import envs, losses, modules

pytestmark = pytest.mark.filterwarnings("default")  # TorchRL announces changes of its next versions


def ppo(env_id="Pendulum-v1", num_envs=2, **kwargs):
    torch.manual_seed(0)
    env = envs.make(env_id, num_envs=num_envs)
    build = modules.categorical_actor if env_id == "CartPole-v1" else modules.gaussian_actor
    actor, critic = build(env, hidden=(16,)), modules.state_value(env, hidden=(16,))
    return env, actor, critic, losses.ClipPPOLoss(actor, critic, **kwargs)


def sac(**kwargs):
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1")
    actor = modules.tanh_normal_actor(env, (16,))
    return env, actor, losses.SACLoss(actor, modules.q_value(env, hidden=(16,)), **kwargs)


def trainer(env, actor, loss, optimizer, steps=2, **kwargs):
    collector = Collector(env, actor, frames_per_batch=64, total_frames=192)
    return Trainer(
        collector=collector, total_frames=192, frame_skip=1, optim_steps_per_batch=steps, loss_module=loss,
        optimizer=optimizer, progress_bar=False, **kwargs,
    )  # fmt: skip


def collected(env, actor):
    return next(iter(Collector(env, actor, frames_per_batch=32, total_frames=32)))


def weights(module):
    return torch.cat([p.detach().flatten() for p in module.parameters()])


def test_ppo_trains_in_torchrl_s_trainer():
    env, actor, critic, loss = ppo()
    made = trainer(env, actor, loss, torch.optim.Adam(loss.parameters(), lr=1e-2), clip_norm=0.5)
    made.register_op("batch_process", GAE(gamma=0.99, lmbda=0.95, value_network=critic))
    made.register_op("batch_process", lambda rollout: rollout.reshape(-1))
    before = weights(loss)
    made.train()
    assert made.collected_frames == 192 and made._optim_count == 6
    assert (weights(loss) - before).abs().max() > 1e-3


def test_sac_trains_in_torchrl_s_trainer_with_soft_update_and_its_replay():
    env, actor, loss = sac()
    loss.make_value_estimator(gamma=0.98)
    made = trainer(env, actor, loss, torch.optim.Adam(loss.parameters(), lr=1e-2))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(500), batch_size=32)
    ReplayBufferTrainer(buffer, flatten_tensordicts=True).register(made)
    made.register_op("post_optim", TargetNetUpdaterHook(SoftUpdate(loss, tau=0.5)))
    critics = weights(loss.qvalue_network_params).clone()
    made.train()
    assert (weights(loss.qvalue_network_params) - critics).abs().max() > 1e-3
    target, source = loss.target_qvalue_network_params, loss.qvalue_network_params
    gap = torch.cat([(target.get(k) - source.get(k)).abs().flatten() for k in target.keys(True, True)])
    assert 0 < gap.max() < (weights(source) - critics).abs().max()


def test_the_trainer_s_subsampler_takes_pgkit_s_rollouts():
    env, actor, critic, loss = ppo("CartPole-v1")
    made = trainer(env, actor, loss, torch.optim.Adam(loss.parameters()), steps=1)
    made.register_op("batch_process", GAE(gamma=0.99, lmbda=0.95, value_network=critic))
    BatchSubSampler(batch_size=16, sub_traj_len=4).register(made)
    made.train()
    assert made._optim_count == 3


@pytest.mark.parametrize("updater", ["soft", "hard"])
def test_updaters_move_the_targets(updater):
    _, _, loss = sac()
    moves = (
        SoftUpdate(loss, tau=0.25) if updater == "soft" else HardUpdate(loss, value_network_update_interval=1)
    )  # at every second step
    key = ("module", "layers", "0", "weight")
    source, target = loss.qvalue_network_params.get(key), loss.target_qvalue_network_params.get(key)
    start = target.clone()
    source.data.add_(1.0)
    moves.step()
    torch.testing.assert_close(target, start + 0.25 if updater == "soft" else start)
    moves.step()
    torch.testing.assert_close(target, start + (0.4375 if updater == "soft" else 1.0))  # 1 - 0.75²


def test_group_optimizers_trains_each_network_at_its_rate():
    env, actor, loss = sac()
    SoftUpdate(loss, tau=0.005)
    batch = collected(env, actor).reshape(-1)
    optimizer = group_optimizers(
        torch.optim.Adam(actor.parameters(), lr=0.0), torch.optim.Adam(loss.qvalue_network_params.parameters(), lr=1e-2)
    )
    before = [weights(x).clone() for x in (actor, loss.qvalue_network_params)]
    out = loss(batch)
    (out["loss_actor"] + out["loss_qvalue"] + out["loss_alpha"]).backward()
    optimizer.step()
    assert torch.equal(weights(actor), before[0]) and not torch.equal(weights(loss.qvalue_network_params), before[1])


@pytest.mark.parametrize("estimator", [e for e in ValueEstimators if e.name in ("GAE", "TD0", "TD1", "TDLambda")])
def test_make_value_estimator_fills_in_the_advantage_as_torchrl_s_loss_would(estimator):
    from torchrl.objectives import ClipPPOLoss as TorchRLClipPPOLoss

    env, actor, critic, mine = ppo(normalize_advantage=False)
    theirs = TorchRLClipPPOLoss(actor, critic, loss_critic_type="l2", entropy_coeff=0.0)
    batch = collected(env, actor)
    results = []
    for loss in (mine, theirs):
        loss.make_value_estimator(estimator, gamma=0.9)
        results.append(loss(batch.copy()))
    for key in ("loss_objective", "loss_critic"):
        torch.testing.assert_close(*(out[key] for out in results))


def test_set_keys_and_dispatch():
    env, actor, loss = sac()
    SoftUpdate(loss, tau=0.005)
    batch = collected(env, actor).reshape(-1)
    torch.manual_seed(1)
    expected = loss(batch.copy())
    loss.set_keys(reward="income")
    renamed = batch.copy().rename_key_(("next", "reward"), ("next", "income"))
    torch.manual_seed(1)
    torch.testing.assert_close(loss(renamed)["loss_qvalue"], expected["loss_qvalue"])
    assert ("next", "income") in loss.in_keys and ("next", "reward") not in loss.in_keys
    names = {key if isinstance(key, str) else "_".join(key): key for key in loss.in_keys}
    torch.manual_seed(1)
    values = loss(**{name: renamed[key] for name, key in names.items()})  # @dispatch: tensors in, a tuple out
    torch.testing.assert_close(values[loss.out_keys.index("loss_qvalue")], expected["loss_qvalue"])


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1"])
def test_actors_collect_in_torchrl_s_collector(env_id):
    env, actor, _, _ = ppo(env_id)
    for rollout in Collector(env, actor, frames_per_batch=64, total_frames=128):
        assert rollout.shape == (2, 32) and rollout["action_log_prob"].shape == (2, 32)
        assert rollout["next", "reward"].shape == (2, 32, 1)
        scored = actor.get_dist(rollout).log_prob(rollout["action"])
        torch.testing.assert_close(scored, rollout["action_log_prob"])


@pytest.mark.parametrize(
    ("env_id", "num_envs"),
    [("Pendulum-v1", 1), ("CartPole-v1", 3), ("HalfCheetah-v5", 2), ("dm_control/cartpole-swingup-v0", 2)],
)
def test_environments_pass_check_env_specs(env_id, num_envs):
    env = envs.make(env_id, num_envs=num_envs)
    check_env_specs(env)
    check_env_specs(TransformedEnv(env, Compose(StepCounter(), RewardScaling(0.0, 0.1))))


def test_a_loss_s_state_dict_moves_its_networks():
    _, actor, loss = sac()
    other_actor, other = sac()[1:]
    for p in other.parameters():
        p.data.normal_()
    observation = TensorDict({"observation": torch.randn(4, 3)}, [4])
    assert not torch.equal(actor.get_dist(observation).loc, other_actor.get_dist(observation).loc)
    other.load_state_dict(loss.state_dict())
    assert torch.equal(actor.get_dist(observation).loc, other_actor.get_dist(observation).loc)
