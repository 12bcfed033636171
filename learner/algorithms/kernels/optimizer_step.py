"""A step of torch's Adam, AdamW or RMSprop on one flat tensor, without the overhead of `Optimizer.step`.

Rule: this step uses the same kernels on the same state as `Optimizer.step`, so it gives the same bits, except that denormal
numbers count as zero during the step. The state belongs to the optimizer, which saves and loads it.

For a small network, the overhead of `Optimizer.step` takes longer than the kernel. In addition, torch imports its compiler
when an optimizer is created and when its first `step` is called, only to exclude the optimizer's methods from compilation.
The import takes 0.8 s and 70 MB, which a learner that compiles nothing can save.

Denormal numbers are set to zero because they are slow. If parameters no longer get a gradient, for example behind a dead
ReLU, their moments decay to denormal numbers within 800 steps and stay there. A step on a CPU then takes twelve times as
long.

This module uses private parts of torch: `torch._fused_adam_`, `torch._fused_adamw_`, `__dynamo_disable`. If the installed
version of torch lacks one of these functions, or if the function accepts other arguments or does something else,
`Optimizer.step` is called instead.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import torch
from torch import Tensor
from torch.optim import Adam, AdamW, Optimizer, RMSprop

COMPILER_MARK = "__dynamo_disable"

OptimizerState = dict[str, Tensor]
Kernel = Callable[..., Any]


def make_optimizer(kind: str, flat: Tensor, **settings: Any) -> Optimizer:
    """Create an Adam, AdamW or RMSprop optimizer for one flat tensor that has a gradient.

    Each update sets the learning rate. Adam has β 0.9 and 0.999, and ε 1e-8 outside the square root; AdamW also decays
    weights by 0.01; RMSprop has α 0.99. `settings`, such as `eps` and `amsgrad`, are arguments for torch's optimizer that
    override these values.
    """
    avoid_compiler_import()
    match kind:
        case "rmsprop":
            return RMSprop([flat], **{"alpha": 0.99} | settings)
        case _:
            return (AdamW if kind == "adamw" else Adam)([flat], fused=True, **settings)


def avoid_compiler_import() -> None:
    """Make it possible to create, save and load optimizers without importing torch's compiler.

    torch wraps some methods of `Optimizer`. The wrapper asks the compiler for a version of the method that is excluded from
    compilation, and stores this version in an attribute. This function stores the method itself in the attribute, so that
    the wrapper does not ask. If torch does not wrap these methods in this way, nothing changes.
    """
    for method in (Optimizer.add_param_group, Optimizer.state_dict, Optimizer.load_state_dict, Optimizer.zero_grad):
        wrapped = getattr(method, "__wrapped__", None)
        if wrapped is not None and not hasattr(wrapped, COMPILER_MARK):
            setattr(wrapped, COMPILER_MARK, wrapped)


def take_step(optimizer: Optimizer) -> None:
    """Like `optimizer.step()`, for a fused Adam or AdamW, or a plain RMSprop, on one flat tensor that has a gradient."""
    (group,) = optimizer.param_groups
    (flat,) = group["params"]
    step = _step_of(optimizer)
    if step is None or not flat.is_cpu:
        optimizer.step()
        return
    state = optimizer.state.get(flat) or _initial_state(optimizer, flat, group)
    optimizer.state[flat] = state
    torch.set_flush_denormal(True)
    try:
        step(flat, group, state)
    finally:  # other code in this thread, such as numpy or an environment, depends on denormal numbers
        torch.set_flush_denormal(False)


def state_of(optimizer: Optimizer) -> dict[str, Any]:
    """A copy of `optimizer.state_dict()`. It takes one twentieth of the time that a deep copy would take."""
    numbers = {flat: i for i, flat in enumerate(flat for group in optimizer.param_groups for flat in group["params"])}
    state = {
        numbers[flat]: {name: each.clone() if isinstance(each, Tensor) else each for name, each in kept.items()}
        for flat, kept in optimizer.state.items()
    }
    groups = [{**group, "params": [numbers[flat] for flat in group["params"]]} for group in optimizer.param_groups]
    return {"state": state, "param_groups": groups}


def load_state(optimizer: Optimizer, state: dict[str, Any]) -> None:
    """Load a copy of `state`. Raises ValueError if it belongs to another kind of optimizer or to another network."""
    (own_group,) = optimizer.param_groups
    optimizer.load_state_dict(copy.deepcopy(state))
    (group,) = optimizer.param_groups
    (flat,) = group["params"]
    if odd := [name for name, value in own_group.items() if type(group.get(name)) is not type(value)]:
        expected, got = (type(each.get(odd[0])).__name__ for each in (own_group, group))
        raise ValueError(f"optimizer: {odd[0]}: expected {expected}, got {got}")
    if optimizer.state.keys() - {flat}:
        raise ValueError("optimizer: expected moments of its own parameters, got those of others")
    if _step_of(optimizer) is not None and (kept := optimizer.state.get(flat)):
        own = _initial_state(optimizer, flat, group)
        if {name: each.shape for name, each in own.items()} != {name: each.shape for name, each in kept.items()}:
            raise ValueError(f"optimizer: expected {', '.join(own)} of {len(flat)} numbers, got {', '.join(kept)}")


def _step_of(optimizer: Optimizer) -> Callable[[Tensor, dict[str, Any], OptimizerState], None] | None:
    """The function that steps this kind of optimizer; None for an unknown kind, or if this torch lacks its kernel."""
    match optimizer:
        case AdamW():  # must precede Adam, of which AdamW is a subclass in newer versions of torch
            return _adam_step("_fused_adamw_", decayed_parameter=0.85)
        case Adam():
            return _adam_step("_fused_adam_", decayed_parameter=0.9)
        case RMSprop():
            return _rmsprop
        case _:
            return None


def _adam_step(name: str, decayed_parameter: float) -> Callable[[Tensor, dict[str, Any], OptimizerState], None] | None:
    """The Adam step that uses this private torch function; None if torch lacks it, or if it does something else."""
    kernel = getattr(torch, name, None)
    return partial(_adam, kernel) if kernel is not None and _is_adam(kernel, decayed_parameter) else None


@cache
def _is_adam(kernel: Kernel, decayed_parameter: float) -> bool:
    """Whether a first step with learning rate 0.1, gradient 1 and weight decay 0.5 changes 1 to `decayed_parameter`.

    Adam adds the decay to the gradient, whose size does not matter in a first step, so the result is 1 - 0.1. AdamW reduces
    the parameter itself, so the result is (1 - 0.1 · 0.5) - 0.1.
    """
    flat = torch.ones(1)
    flat.grad = torch.ones(1)
    group = {"lr": 0.1, "betas": (0.9, 0.999), "eps": 1e-8, "weight_decay": 0.5, "amsgrad": False}
    state = {"step": torch.zeros(()), "exp_avg": torch.zeros(1), "exp_avg_sq": torch.zeros(1)}
    try:
        _adam(kernel, flat, group, state)
    except (TypeError, RuntimeError, NotImplementedError):  # torch raises these for arguments that it does not know
        return False
    return abs(flat.item() - decayed_parameter) < 1e-5


def _initial_state(optimizer: Optimizer, flat: Tensor, group: dict[str, Any]) -> OptimizerState:
    """The optimizer's state before its first step, with torch's own names."""
    if isinstance(optimizer, RMSprop):
        names = ["square_avg"]
    else:
        names = ["exp_avg", "exp_avg_sq", *(["max_exp_avg_sq"] if group["amsgrad"] else [])]
    return {"step": torch.zeros(())} | {name: torch.zeros_like(flat) for name in names}


def _adam(kernel: Kernel, flat: Tensor, group: dict[str, Any], state: OptimizerState) -> None:
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


def _rmsprop(flat: Tensor, group: dict[str, Any], state: OptimizerState) -> None:
    gradient = flat.grad
    assert gradient is not None
    state["step"] += 1
    state["square_avg"].mul_(group["alpha"]).addcmul_(gradient, gradient, value=1 - group["alpha"])
    flat.addcdiv_(gradient, state["square_avg"].sqrt().add_(group["eps"]), value=-group["lr"])
