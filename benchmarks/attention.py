"""
The encoder's attention (torch's fused kernel) against explicit matrix products, and against the kernel in bfloat16,
forward and backward.

    python benchmarks/attention.py
"""

import argparse
import math
import time
from typing import Any

import torch as th

from sb3_uav.policies.encoder import attend


def written_out(query: th.Tensor, key: th.Tensor, value: th.Tensor, n_heads: int, bias: th.Tensor | None) -> th.Tensor:
    """Attention as matrix products and a softmax."""
    query, key, value = (part.unflatten(-1, (n_heads, -1)).transpose(1, 2) for part in (query, key, value))
    scores = (query / math.sqrt(query.shape[-1])) @ key.transpose(2, 3)
    scores = scores if bias is None else scores + bias
    return (scores.softmax(-1) @ value).transpose(1, 2).flatten(2)


def in_bfloat16(query: th.Tensor, key: th.Tensor, value: th.Tensor, n_heads: int, bias: th.Tensor | None) -> th.Tensor:
    """The kernel in bfloat16, as under autocast."""
    query, key, value = (part.bfloat16().unflatten(-1, (n_heads, -1)).transpose(1, 2) for part in (query, key, value))
    mask = None if bias is None else bias.bfloat16()
    return th.nn.functional.scaled_dot_product_attention(query, key, value, attn_mask=mask).transpose(1, 2).flatten(2)


def seconds(attention: Any, inputs: list[th.Tensor], n_heads: int, bias: th.Tensor | None, repeats: int) -> float:
    """:return: Seconds of one forward and backward pass, best of several"""
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        attention(*inputs, n_heads, bias).sum().backward()
        best = min(best, time.perf_counter() - start)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch-size", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    columns = f"{'nodes':>5} {'width':>5} {'heads':>5} {'padding':>7} {'fused':>9}"
    print(f"{columns} {'written out':>12} {'ratio':>6} {'bfloat16':>11} {'ratio':>6}")
    for n_nodes, embed_dim, n_heads in ((8, 32, 4), (21, 64, 4), (21, 128, 8), (81, 64, 4), (81, 128, 8), (201, 128, 8)):
        inputs = [th.randn(args.batch_size, n_nodes, embed_dim, requires_grad=True) for _ in range(3)]
        for padded in (False, True):
            bias = None
            if padded:
                bias = th.zeros(args.batch_size, 1, 1, n_nodes)
                bias[:, ..., n_nodes // 2 :] = -th.inf
            fused, products, halves = (
                seconds(function, inputs, n_heads, bias, args.repeats) for function in (attend, written_out, in_bfloat16)
            )
            print(
                f"{n_nodes:5} {embed_dim:5} {n_heads:5} {padded!s:>7} {fused * 1e3:6.2f} ms {products * 1e3:9.2f} ms "
                f"{products / fused:5.2f}x {halves * 1e3:8.2f} ms {halves / fused:5.2f}x"
            )


if __name__ == "__main__":
    main()
