"""A step of torch's Adam, AdamW or RMSprop on one flat tensor, without the ceremony of `Optimizer.step`.

The law: the same kernels on the same state, so the same bits (a test holds them equal). The state stays the optimiser's
own, saved and loaded by it; but that denormal numbers are zero meanwhile. For a small network the ceremony takes longer than
the kernel; and its first step, as making an optimiser, imports torch's compiler only to tell it to keep away: 0.8 s and
70 MB, which a learner that compiles nothing does without.

The moments of parameters that have no gradient any more, as those of a dead ReLU, fall to denormal numbers within 800 steps,
and stay there: a step with them takes a CPU twelve times as long.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.optim import Adam, AdamW, Optimizer, RMSprop

MARK = "__dynamo_disable"


def spare_the_compiler() -> None:
    """Let optimisers be made, saved and loaded without importing it. Where torch does not mark functions so, it does.

    torch keeps what the compiler made of such a function beside it; we keep the function itself there.
    """
    for method in (Optimizer.add_param_group, Optimizer.state_dict, Optimizer.load_state_dict, Optimizer.zero_grad):
        own = getattr(method, "__wrapped__", None)
        if own is not None and not hasattr(own, MARK):
            setattr(own, MARK, own)


def take_step(optimizer: Optimizer) -> None:
    """`optimizer.step()`: fused Adam and AdamW, plain RMSprop, of one tensor that is no leaf of a graph."""
    (group,) = optimizer.param_groups
    (flat,) = group["params"]
    state = optimizer.state.get(flat) or _first(optimizer, flat, group)
    if not state or not flat.is_cpu:
        optimizer.step()
        return
    optimizer.state[flat] = state
    torch.set_flush_denormal(True)
    try:
        match optimizer:
            case AdamW():  # before Adam: in newer versions it is one
                _adam(torch._fused_adamw_, flat, group, state)
            case Adam():
                _adam(torch._fused_adam_, flat, group, state)
            case RMSprop():
                _rmsprop(flat, group, state)
            case _:
                optimizer.step()
    finally:  # environments that are evaluated in this thread, and numpy's, count on them
        torch.set_flush_denormal(False)


def _first(optimizer: Optimizer, flat: Tensor, group: dict[str, Any]) -> dict[str, Tensor]:
    """The state before the first step; none of an optimiser that we do not know, which makes it itself."""
    match optimizer:
        case Adam() | AdamW():
            names = ["exp_avg", "exp_avg_sq", *(["max_exp_avg_sq"] if group["amsgrad"] else [])]
        case RMSprop():
            names = ["square_avg"]
        case _:
            return {}
    return {"step": torch.zeros(())} | {name: torch.zeros_like(flat) for name in names}


def _adam(kernel: Any, flat: Tensor, group: dict[str, Any], state: dict[str, Tensor]) -> None:
    beta1, beta2 = group["betas"]
    state["step"] += 1
    kernel(
        [flat],
        [flat.grad],
        [state["exp_avg"]],
        [state["exp_avg_sq"]],
        [state["max_exp_avg_sq"]] if group["amsgrad"] else [],
        [state["step"]],
        lr=group["lr"],
        beta1=beta1,
        beta2=beta2,
        weight_decay=group["weight_decay"],
        eps=group["eps"],
        amsgrad=group["amsgrad"],
        maximize=False,
    )


def _rmsprop(flat: Tensor, group: dict[str, Any], state: dict[str, Tensor]) -> None:
    gradient = flat.grad
    assert gradient is not None
    state["step"] += 1
    state["square_avg"].mul_(group["alpha"]).addcmul_(gradient, gradient, value=1 - group["alpha"])
    flat.addcdiv_(gradient, state["square_avg"].sqrt().add_(group["eps"]), value=-group["lr"])
