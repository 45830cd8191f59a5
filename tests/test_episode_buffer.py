"""The episode rollout buffer: the same training as with SB3's buffers, with every instance stored and encoded once."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.buffers import MaskableDictRolloutBuffer
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize
from torch.nn import functional

from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator
from sb3_uav.envs.problem import STATIC_KEYS
from sb3_uav.envs.routing import RoutingProblem
from sb3_uav.policies import AllocatorPolicy, RouterExtractor, RouterPolicy
from sb3_uav.policies.grouping import EPISODE_INDEX, Grouping
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import EpisodeBufferCallback, EpisodeRolloutBuffer, MaskableEpisodeRolloutBuffer
from sb3_uav.training.episode_buffer import _split_evenly, use_episode_buffer

N_TASKS, N_ENVS, N_STEPS = 7, 4, 10
LEVELS = ("allocator", "router")
BUFFERS: dict[Any, Any] = {
    PPO: EpisodeRolloutBuffer,
    A2C: EpisodeRolloutBuffer,
    MaskablePPO: MaskableEpisodeRolloutBuffer,
}


def make_model(level: str, algorithm: Any = PPO, **kwargs: Any) -> Any:
    def make_env() -> Any:
        return TaskAllocationEnv(N_TASKS, 3) if level == "allocator" else RoutePlanningEnv(N_TASKS)

    policy = AllocatorPolicy if level == "allocator" else RouterPolicy
    small = dict(embed_dim=16, n_layers=2, n_heads=4, ff_dim=32)
    arguments: dict[str, Any] = dict(n_steps=N_STEPS, policy_kwargs=small, seed=0, device="cpu", gamma=1.0)
    if algorithm is not A2C:
        arguments["batch_size"] = N_STEPS * N_ENVS
    return algorithm(policy, BatchedVecEnv([make_env] * N_ENVS), **{**arguments, **kwargs})


class Recorder(BaseCallback):
    """Fills a second buffer with the same rollout."""

    def __init__(self, buffer: DictRolloutBuffer) -> None:
        super().__init__()
        self.buffer = buffer

    def _on_training_start(self) -> None:
        model: Any = self.model
        original = model.rollout_buffer.add

        def add_to_both(*args: Any, **kwargs: Any) -> None:
            original(*args, **kwargs)
            self.buffer.add(*args, **kwargs)

        model.rollout_buffer.add = add_to_both

    def _on_rollout_start(self) -> None:
        self.buffer.reset()

    def _on_step(self) -> bool:
        return True


def collect_twice(level: str, algorithm: Any = PPO) -> tuple[Any, Any]:
    """:return: A model whose stock buffer holds a rollout, and our buffer with the same one; episodes are cut at both ends"""
    model = make_model(level, algorithm)
    ours = BUFFERS[algorithm](N_STEPS, model.observation_space, model.action_space, "cpu", model.gae_lambda, 1.0, N_ENVS)
    recorder = Recorder(ours)
    _, callback = model._setup_learn(10_000, recorder)
    recorder.on_training_start({}, {})
    for _ in range(2):
        model.collect_rollouts(model.env, callback, model.rollout_buffer, N_STEPS)
    with th.no_grad():
        last_values = model.policy.predict_values(model.policy.obs_to_tensor(model._last_obs)[0])
    ours.compute_returns_and_advantage(last_values, model._last_episode_starts)
    return model, ours


def flat(buffer: Any) -> Any:
    """Let the buffer put its data in order, which it does when it is first read."""
    next(iter(buffer.get()))
    return buffer


def loss_and_gradients(model: Any, samples: Any) -> tuple[th.Tensor, list[th.Tensor]]:
    """PPO's loss of one minibatch, with new advantages instead of the rollout's, some of which are 0."""
    masks = {"action_masks": samples.action_masks} if hasattr(samples, "action_masks") else {}
    model.policy.set_training_mode(True)
    model.policy.zero_grad()
    values, log_prob, entropy = model.policy.evaluate_actions(samples.observations, samples.actions.long().flatten(), **masks)
    ratio = (log_prob - samples.old_log_prob).exp()
    loss = -(samples.advantages * ratio).mean() + functional.mse_loss(samples.returns, values.flatten()) - entropy.mean()
    loss.backward()
    return loss.detach(), [p.grad.clone() for p in model.policy.parameters() if p.grad is not None]


# ------------------------------------------------------------------------------------------ equal to SB3's buffers


@pytest.mark.parametrize("algorithm", [PPO, MaskablePPO])
@pytest.mark.parametrize("level", LEVELS)
def test_the_same_minibatch_gives_the_same_loss_and_gradients(level, algorithm):
    """Whole episodes, steps picked at random, and everything at once."""
    model, ours = collect_twice(level, algorithm)
    stock = flat(model.rollout_buffer)
    flat(ours)
    rng = np.random.default_rng(0)
    whole_episodes = np.arange(2 * N_STEPS)
    for indices in (whole_episodes, rng.permutation(N_STEPS * N_ENVS)[:13], np.arange(N_STEPS * N_ENVS)):
        # Every step encoded for itself, as SB3 would.
        model.policy.features_extractor.share_encodings = False
        expected, expected_gradients = loss_and_gradients(model, stock._get_samples(indices))
        model.policy.features_extractor.share_encodings = True
        for samples in (stock._get_samples(indices), ours._get_samples(indices)):
            loss, gradients = loss_and_gradients(model, samples)
            th.testing.assert_close(loss, expected, atol=1e-5, rtol=1e-5)
            assert len(gradients) == len(expected_gradients) > 10
            for gradient, reference in zip(gradients, expected_gradients, strict=True):
                th.testing.assert_close(gradient, reference, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("level", LEVELS)
def test_every_field_is_that_of_the_stock_buffer(level):
    """Advantages, returns and all parts of the observations, episodes cut in two included."""
    model, ours = collect_twice(level)
    stock = flat(model.rollout_buffer)
    assert (stock.advantages != 0).any()
    samples, expected = flat(ours)._get_samples(np.arange(N_STEPS * N_ENVS)), stock._get_samples(np.arange(N_STEPS * N_ENVS))
    for name in ("actions", "old_values", "old_log_prob", "advantages", "returns"):
        assert th.equal(getattr(samples, name), getattr(expected, name)), name
    index = samples.observations.pop(EPISODE_INDEX)
    assert set(samples.observations) == set(expected.observations)
    for key, value in expected.observations.items():
        found = samples.observations[key][index] if key in STATIC_KEYS else samples.observations[key]
        assert th.equal(found, value), key


@pytest.mark.parametrize("level", LEVELS)
def test_training_with_one_full_batch_agrees_with_the_stock_buffer(level):
    """Several updates: parameters drift apart by rounding only."""
    parameters = []
    for buffer_class in (None, EpisodeRolloutBuffer):
        model = make_model(level, n_epochs=2, learning_rate=1e-3, rollout_buffer_class=buffer_class)
        model.learn(3 * N_STEPS * N_ENVS)
        parameters.append(th.nn.utils.parameters_to_vector(model.policy.parameters()))
    start = th.nn.utils.parameters_to_vector(make_model(level).policy.parameters())
    assert (parameters[0] - start).abs().max() > 1e-3
    th.testing.assert_close(parameters[1], parameters[0], atol=2e-4, rtol=0)


@pytest.mark.parametrize("algorithm", [PPO, MaskablePPO])
@pytest.mark.parametrize("level", LEVELS)
def test_first_full_batch_epoch_has_ratio_one(level, algorithm):
    """Collection and training compute the same probabilities."""
    model = make_model(level, algorithm, n_epochs=1, rollout_buffer_class=BUFFERS[algorithm])
    model.learn(N_STEPS * N_ENVS)
    assert model.logger.name_to_value["train/approx_kl"] == pytest.approx(0.0, abs=1e-7)
    assert model.logger.name_to_value["train/clip_fraction"] == 0.0


def test_a_wrapper_that_changes_the_static_part_at_every_step_is_stored_as_it_is():
    """VecNormalize's statistics move on within an episode."""
    model = make_model("router", n_epochs=1, rollout_buffer_class=EpisodeRolloutBuffer)
    model.env = VecNormalize(model.env, norm_obs_keys=["tasks", "depot"])
    model.learn(N_STEPS * N_ENVS)
    assert model.logger.name_to_value["train/approx_kl"] == pytest.approx(0.0, abs=1e-7)
    assert model.rollout_buffer._n_fragments > N_ENVS * N_STEPS // 2


# ------------------------------------------------------------------------------------------ storing and encoding once


def test_an_instance_is_stored_once_per_episode():
    model, ours = collect_twice("allocator")
    # Episodes of 7 steps in rollouts of 10: the second rollout holds 4 steps of one and 6 of the next.
    n_fragments = [1 + int(model.rollout_buffer.episode_starts[1:, env].sum()) for env in range(N_ENVS)]
    assert n_fragments == [2] * N_ENVS
    static = flat(ours)._get_samples(np.arange(N_STEPS * N_ENVS)).observations
    assert len(static["tasks"]) == sum(n_fragments)
    assert set(ours.observations) == {"assignment", "current_task", "action_mask"}


@pytest.mark.parametrize(("level", "batch_size"), [("allocator", 14), ("router", 9), ("router", None)])
def test_a_pass_has_every_step_once_and_fragments_whole(level, batch_size):
    _, ours = collect_twice(level)
    fragments = np.repeat(np.arange(flat(ours)._n_fragments), np.diff(ours._starts))
    ours._get_samples = lambda indices: indices
    np.random.seed(0)
    first, second = list(ours.get(batch_size)), list(ours.get(batch_size))
    for batches in (first, second):
        assert sorted(np.concatenate(batches)) == list(range(N_STEPS * N_ENVS))
        seen = [set(fragments[batch]) for batch in batches]
        assert sum(map(len, seen)) == len(set().union(*seen)), "a fragment stands in two minibatches"
    if batch_size is not None:
        assert len(first) > 1 and not np.array_equal(np.concatenate(first), np.concatenate(second))


@pytest.mark.parametrize("algorithm", [PPO, A2C, MaskablePPO])
def test_an_instance_is_encoded_once_per_epoch_of_training(algorithm):
    model = make_model("allocator", algorithm, rollout_buffer_class=BUFFERS[algorithm])
    _, callback = model._setup_learn(10_000)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, N_STEPS)
    extractor = model.policy.features_extractor
    extractor.n_encoded_rows = 0
    model.train()
    # Each environment has played one whole episode and a part of the next.
    assert extractor.n_encoded_rows == 2 * N_ENVS * getattr(model, "n_epochs", 1)


@pytest.mark.parametrize(("share_encodings", "encoded"), [(True, N_ENVS), (False, N_ENVS * N_TASKS)])
def test_without_the_buffer_equal_instances_of_a_minibatch_are_encoded_once(share_encodings, encoded):
    model = make_model("allocator", n_steps=N_TASKS, batch_size=N_TASKS * N_ENVS, n_epochs=1)
    extractor = model.policy.features_extractor
    extractor.share_encodings = share_encodings
    _, callback = model._setup_learn(10_000)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, N_TASKS)
    extractor.n_encoded_rows = 0
    model.train()
    assert extractor.n_encoded_rows == encoded


def test_memory_per_step_is_that_of_the_changing_part():
    """What a step takes does not grow with the static part of the observation."""

    def bytes_per_step(n_tasks: int) -> float:
        env: Any = TaskAllocationEnv(n_tasks, 3)
        buffer = EpisodeRolloutBuffer(50, env.observation_space, env.action_space, "cpu", n_envs=2)
        return sum(field.nbytes for field in buffer.observations.values()) / 100

    per_task = (bytes_per_step(40) - bytes_per_step(20)) / 20
    assert per_task == np.dtype(np.float32).itemsize, "only the assignment may grow with the number of tasks"


@pytest.mark.parametrize("level", LEVELS)
def test_an_instance_with_most_of_the_steps_does_not_fill_the_table_with_copies(level):
    """The other way to decode computes the same, instances encoded once all the same."""
    model, ours = collect_twice(level)
    flat(ours)
    lengths = np.diff(ours._starts)
    one_step_each = ours._starts[:-1]
    longest = int(lengths.argmax())
    indices = np.union1d(one_step_each, np.arange(*ours._starts[longest : longest + 2]))
    observations = ours._get_samples(indices).observations
    grouping = Grouping.by_instance(observations[EPISODE_INDEX], len(lengths))
    results = []
    for limit in (grouping.source.numel() / len(indices) / 2, grouping.source.numel()):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("sb3_uav.policies.extractor._MAX_FILLING", limit)
            model.policy.features_extractor.n_encoded_rows = 0
            results.append(model.policy.evaluate_actions(observations, th.zeros(len(indices))))
            assert model.policy.features_extractor.n_encoded_rows == len(lengths)
    for copied, grouped in zip(*results, strict=True):
        th.testing.assert_close(copied, grouped, atol=1e-5, rtol=1e-5)


# ------------------------------------------------------------------------------------------ minibatches


@given(st.lists(st.integers(1, 30), min_size=1, max_size=40), st.integers(1, 200))
def test_fragments_are_split_evenly(lengths, batch_size):
    lengths_array = np.array(lengths)
    runs = _split_evenly(lengths_array, batch_size)
    assert np.concatenate(runs).tolist() == list(range(len(lengths)))
    sizes = [int(lengths_array[run].sum()) for run in runs]
    assert min(sizes) > 1 or len(sizes) == 1
    # Half a fragment over at either end, and one step that was left alone.
    assert max(sizes) <= batch_size + max(lengths) + 1


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
@pytest.mark.parametrize("algorithm", [PPO, MaskablePPO])
def test_a_truncated_minibatch_of_one_step_keeps_weights_finite(algorithm):
    """MaskablePPO 2.9.2 normalizes the advantage of a single step to NaN; no minibatch of ours is that small."""
    n_steps, batch_size = 7, 9
    assert n_steps * N_ENVS % batch_size == 1
    model = make_model("router", algorithm, n_steps=n_steps, batch_size=batch_size, rollout_buffer_class=BUFFERS[algorithm])
    model.learn(2 * n_steps * N_ENVS)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


@given(st.lists(st.integers(0, 5), min_size=1, max_size=30))
def test_grouping_puts_every_transition_into_its_instances_row(index):
    _, dense = np.unique(index, return_inverse=True)
    instance = th.as_tensor(dense)
    grouping = Grouping.by_instance(instance, int(dense.max()) + 1)
    transition = th.arange(len(index))
    assert th.equal(grouping.scatter(grouping.gather(transition)), transition)
    assert (grouping.gather(instance) == th.arange(int(dense.max()) + 1)[:, None]).all()


# ------------------------------------------------------------------------------------------ installing it


@pytest.mark.parametrize(
    ("algorithm", "expected"),
    [(PPO, EpisodeRolloutBuffer), (A2C, EpisodeRolloutBuffer), (MaskablePPO, MaskableEpisodeRolloutBuffer)],
)
def test_the_callback_installs_the_buffer_and_the_stock_class_loads_the_zip(algorithm, expected, tmp_path):
    model = make_model("router", algorithm, gae_lambda=0.9)
    model.learn(2 * N_STEPS * N_ENVS, callback=EpisodeBufferCallback())
    assert type(model.rollout_buffer) is expected
    assert (model.rollout_buffer.gamma, model.rollout_buffer.gae_lambda) == (1.0, 0.9)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=model.get_env(), device="cpu")
    assert isinstance(loaded.rollout_buffer, (DictRolloutBuffer, MaskableDictRolloutBuffer))
    loaded.learn(N_STEPS * N_ENVS, callback=EpisodeBufferCallback(), reset_num_timesteps=False)
    assert type(loaded.rollout_buffer) is expected and loaded.num_timesteps == 3 * N_STEPS * N_ENVS


def test_installing_twice_keeps_the_buffer():
    model = make_model("router", rollout_buffer_class=EpisodeRolloutBuffer)
    buffer = model.rollout_buffer
    use_episode_buffer(model)
    assert model.rollout_buffer is buffer


def test_foreign_algorithms_policies_buffers_and_spaces_are_refused():
    env = BatchedVecEnv([lambda: RoutePlanningEnv(N_TASKS)])
    kwargs = dict(features_extractor_class=RouterExtractor, features_extractor_kwargs=dict(embed_dim=16, n_heads=4))
    with pytest.raises(ValueError, match="found PPO with MultiInputActorCriticPolicy"):
        use_episode_buffer(PPO("MultiInputPolicy", env, policy_kwargs=kwargs, n_steps=2, batch_size=2, device="cpu"))
    with pytest.raises(ValueError, match="found REINFORCE"):
        use_episode_buffer(REINFORCE("MlpPolicy", "CartPole-v1", device="cpu"))

    class OtherBuffer(DictRolloutBuffer):
        pass

    with pytest.raises(ValueError, match="found OtherBuffer"):
        use_episode_buffer(make_model("router", rollout_buffer_class=OtherBuffer))
    with pytest.raises(ValueError, match="use SB3's own buffer"):
        EpisodeRolloutBuffer(2, spaces.Dict({"depot": spaces.Box(0, 1, (2,))}), env.action_space)


# ------------------------------------------------------------------------------------------ masks


@pytest.mark.parametrize("algorithm", [PPO, A2C, MaskablePPO])
def test_a_thousand_actions_train_and_only_legal_ones_are_taken(algorithm):
    """A thousand actions used to break the masked categorical (sb3-contrib issues 81 and 247)."""
    kwargs = {} if algorithm is A2C else {"batch_size": 8, "n_epochs": 1}
    env = BatchedVecEnv([lambda: RoutePlanningEnv(999)] * 2)
    network = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)
    illegal: list[int] = []

    class CountIllegal(BaseCallback):
        def _on_step(self) -> bool:
            illegal.extend(info["illegal_actions"] for info in self.locals["infos"])
            return True

    model = algorithm(
        RouterPolicy, env, n_steps=8, policy_kwargs=network, rollout_buffer_class=BUFFERS[algorithm], device="cpu", **kwargs
    )
    model.learn(32, callback=CountIllegal())
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    assert len(illegal) == 32 and not any(illegal)


# ------------------------------------------------------------------------------------------ learning


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [PPO, MaskablePPO])
def test_the_router_learns(algorithm):
    """On these instances random tours visit 4.5 of 20 tasks; after 20,000 steps 7.5 were seen."""
    n_tasks, n_envs = 20, 64
    model = algorithm(
        RouterPolicy,
        BatchedVecEnv([lambda: RoutePlanningEnv(n_tasks)] * n_envs),
        learning_rate=1e-3,
        n_steps=32,
        batch_size=256,
        n_epochs=4,
        gamma=1.0,
        rollout_buffer_class=BUFFERS[algorithm],
        # With geometry it would begin with good tours.
        policy_kwargs=dict(embed_dim=32, n_layers=2, n_heads=4, ff_dim=64, geometry=False),
        seed=0,
        device="cpu",
    )
    generator = UniformGenerator(n_tasks, n_uavs=1)
    instances = generator(256, np.random.default_rng(0))

    def mean_return() -> float:
        return float(RoutingProblem(generator).returns(instances, model.policy.decode_episodes(instances)).mean())

    assert mean_return() < 5.0
    model.learn(20_480)
    assert mean_return() > 6.5
