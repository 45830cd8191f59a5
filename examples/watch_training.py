"""
Train both levels with TensorBoard, then draw what its event files hold.

    python examples/watch_training.py --out watch.png
    tensorboard --logdir watched

The greedy schedule of one fixed instance before and after the training, and the learning curves of both levels on their common
axis: the steps that either of them has learned from.
"""

# SB3 accepts more types than its annotations state.
# mypy: disable-error-code="arg-type"
import argparse
import io

import matplotlib.image
import matplotlib.pyplot as plt
from stable_baselines3.common.env_util import make_vec_env
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_uav.envs import BatchedVecEnv
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import FixedSetEvalCallback, ITSCallback

parser = argparse.ArgumentParser()
parser.add_argument("--epochs", type=int, default=8, help="epochs of the allocator")
parser.add_argument("--instances", type=int, default=1280, help="instances of an epoch")
parser.add_argument("--out", default="watch.png", help="the picture to write")
args = parser.parse_args()

network = dict(embed_dim=32, n_layers=2, n_heads=4, ff_dim=64)
settings = dict(n_samples=8, baseline="shared", normalize_advantage=True, learning_rate=1e-3, policy_kwargs=network)
env = make_vec_env("TaskAllocation-U3-N20-v0", n_envs=32, vec_env_cls=BatchedVecEnv)
model = REINFORCE("AllocatorPolicy", env, instances_per_epoch=args.instances, tensorboard_log="watched", seed=0, **settings)
its = ITSCallback(
    dict(policy="RouterPolicy", **settings), args.epochs, n_pretraining_epochs=4, n_intensive_epochs=4, n_continuous_epochs=2
)
model.learn(10**9, callback=[its, FixedSetEvalCallback(n_instances=128, n_samples=8)])

runs = {"allocator": model.logger.dir, "router": f"{model.logger.dir}/router"}
events = {level: EventAccumulator(folder, size_guidance=dict(scalars=0, images=0)).Reload() for level, folder in runs.items()}
maps = events["allocator"].Images("eval/schedule")
curves = {level: read.Scalars("rollout/ep_rew_mean") for level, read in events.items()}

figure, (before, after, chart) = plt.subplots(1, 3, figsize=(15, 5.6), width_ratios=(1, 1, 1.1), layout="constrained")
for axes, drawn in ((before, maps[0]), (after, maps[-1])):
    axes.imshow(matplotlib.image.imread(io.BytesIO(drawn.encoded_image_string), format="png"))
    axes.set_title(f"eval/schedule at step {drawn.step:,}")
    axes.set_axis_off()
for level, points in curves.items():
    chart.plot([point.step for point in points], [point.value for point in points], ".", markersize=2, label=level)
chart.set(title="rollout/ep_rew_mean", xlabel="steps that either level has learned from", ylabel="tasks")
chart.legend(markerscale=6)
figure.savefig(args.out, dpi=80)
print(f"{len(maps)} maps, {', '.join(f'{len(points)} points of the {level}' for level, points in curves.items())}: {args.out}")
