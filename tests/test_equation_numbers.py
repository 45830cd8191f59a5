"""Docstrings cite the paper's equations by the numbers that they have there (arXiv:2208.02447)."""

import inspect
import re
from importlib import import_module

import pytest

# Citing object: the equations' numbers in the paper, counted through its text.
CITATIONS = {
    # The model: objective and constraints up to the maximum distance.
    "sb3_uav.envs.schedule:check_schedule": {1, 6},
    "sb3_uav.solvers.milp": {1, 8},
    # The encoder: queries, keys and values; softmax of their products; heads together; the two sublayers.
    "sb3_uav.policies.encoder:SelfAttention": {10, 12},
    # The allocator's decoder: maximum over a UAV's tasks; all UAVs together; feed-forward; softmax.
    "sb3_uav.policies.allocator:AllocatorExtractor": {15, 17, 18},
    # The router's decoder: context; glimpse; clipped compatibilities.
    "sb3_uav.policies.router:RouterExtractor": {20, 22},
    # The gradient of the loss, and the gap.
    "sb3_uav.reinforce.losses:episode_loss": {24},
    "sb3_uav.evaluation.summary:gaps": {25},
}


@pytest.mark.parametrize("citing", sorted(CITATIONS))
def test_equations_have_the_papers_numbers(citing):
    name, _, path = citing.partition(":")
    cited = import_module(name)
    for attribute in filter(None, path.split(".")):
        cited = getattr(cited, attribute)
    found = re.findall(r"equations? ((?:\(\d+\)(?: to | and )?)+)", inspect.getdoc(cited) or "")
    assert {int(number) for text in found for number in re.findall(r"\d+", text)} == CITATIONS[citing]
