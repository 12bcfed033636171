"""A user-defined encoder: a torch module between the observation and the rest of the network. Imports torch.

`module:factory` names a callable: factory(features, images) -> torch.nn.Module. `features` is the number of features of all
arrays of an observation that are not images; `images` has the shapes of the images. The module is called with the features
[B, features] float32 (normalized if the run normalizes observations), then with each image [B, *shape] uint8. It returns
[B, K] float32. The recurrent core, the hidden layers and the heads follow, just as without an encoder. Actor and critic
share one encoder.

The encoder's parameters are in the flat buffer with all others. The module must have no other state, because buffers (such
as the running mean of BatchNorm) are not sent with the weights. It must not use dropout, because the learner could not
reproduce the worker's probabilities.
"""

from __future__ import annotations

from typing import Any

import torch

from millrace.protocol.errors import UsageError, first_line
from millrace.protocol.own_module import own_callable
from millrace.protocol.policy.features import feature_size
from millrace.protocol.policy.flattened_images import is_stack
from millrace.protocol.random_streams import Purpose, torch_seed
from millrace.protocol.specs import ActionSpec, EncoderSpec, Leaf, NamedShape, PolicySpec

ROWS = 2  # observations in a trial pass: with only one, a module that mixes up rows would go unnoticed


def describe_encoder(factory: str, observation: tuple[Leaf, ...], action: ActionSpec) -> EncoderSpec:
    """Make the encoder once, to find out its parameters and its output size.

    Raises `UsageError`, with a one-line message, if it cannot be made, or its output has the wrong shape or dtype.
    """
    spec = PolicySpec(observation, action)
    module = _make(factory, spec, seed=0)
    return EncoderSpec(factory, _parameter_shapes(module), _output_size(factory, module, spec))


def make_encoder(spec: PolicySpec, seed: int) -> torch.nn.Module:
    """The encoder of this policy, with the initial weights for this seed.

    Raises `UsageError` if it cannot be made, or its parameters differ from those in the spec.
    """
    wanted = spec.encoder
    assert wanted is not None
    module = _make(wanted.factory, spec, seed)
    arrays = _parameter_shapes(module)
    if arrays != wanted.arrays:
        ours, theirs = ({each.name: each.shape for each in of} for of in (arrays, wanted.arrays))
        name = next((name for name in [*ours, *theirs] if ours.get(name) != theirs.get(name)), "order")
        raise UsageError(
            f"encoder {wanted.factory}: parameter {name}: expected {theirs.get(name, 'none')} as the learner has it, got "
            f"{ours.get(name, 'none')}; install the same version of it here and there"
        )
    return module


def multiply_adds_of_encoder(spec: PolicySpec) -> int:
    """Multiply-adds of a forward pass of one observation: for each module, its weights times the positions in its output.

    This is exact for linear layers and convolutions, but too low for LSTM cells and attention, which use weights more often.
    """
    assert spec.encoder is not None
    encoder = _make(spec.encoder.factory, spec, seed=0)
    counts: list[int] = []

    def count(module: torch.nn.Module, _: object, output: Any) -> None:
        first = output[0] if isinstance(output, tuple) and output else output
        if isinstance(first, torch.Tensor):
            weights = [weight for weight in module.parameters(recurse=False) if weight.dim() > 1]  # [out, ...] each
            counts.extend(weight.numel() * (first.numel() // ROWS // max(1, weight.shape[0])) for weight in weights)

    for module in encoder.modules():
        module.register_forward_hook(count)
    _output_size(spec.encoder.factory, encoder, spec)
    return sum(counts)


def _parameter_shapes(module: torch.nn.Module) -> tuple[NamedShape, ...]:
    return tuple(NamedShape(name, tuple(parameter.shape)) for name, parameter in module.named_parameters())


def _make(factory: str, spec: PolicySpec, seed: int) -> torch.nn.Module:
    images = [leaf.shape for leaf in spec.observation if leaf.is_image]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(torch_seed(seed, Purpose.ENCODER))
        try:
            make = own_callable(factory, f"encoder {factory}", "my_package.networks:encoder")
            module = make(feature_size(spec), images)
        except UsageError:
            raise
        except Exception as error:
            raised = f"{type(error).__name__}: {first_line(error)}"
            raise UsageError(f"encoder {factory} cannot be made: {raised}; {_arguments(spec)}") from error
    if not isinstance(module, torch.nn.Module):
        raise UsageError(f"encoder {factory}: expected it to return a torch.nn.Module, got {type(module).__name__}")
    if kept := [name for name, _ in module.named_buffers()]:
        raise UsageError(f"encoder {factory}: expected only parameters, got the buffer {kept[0]}; use LayerNorm, say")
    usual = (torch.float32, torch.get_default_dtype())  # the program or an environment may have set the default
    if strange := [name for name, parameter in module.named_parameters() if parameter.dtype not in usual]:
        raise UsageError(f"encoder {factory}: expected float32 parameters, got another dtype in {strange[0]}")
    return module.float().eval()


def _arguments(spec: PolicySpec) -> str:
    """The arguments that the factory gets, for errors, and why a stack of images isn't among the images."""
    images = [leaf.shape for leaf in spec.observation if leaf.is_image]
    arguments = f"its factory got features={feature_size(spec)}, images={images}"
    if stacks := [leaf for leaf in spec.observation if is_stack(leaf)]:
        leaf = stacks[0]
        advice = f'stack the images along the channels (--wrappers "millrace:StackImages(n={leaf.shape[0]})")'
        return f"{arguments}; {leaf.name} {leaf.dtype}{list(leaf.shape)} has four dimensions, so it isn't an image: {advice}"
    return arguments


def _output_size(factory: str, module: torch.nn.Module, spec: PolicySpec) -> int:
    """The output size K, found by a forward pass on `ROWS` observations of zeros.

    Raises `UsageError` if the module raises, or its output isn't float32 [ROWS, K].
    """
    images = [torch.zeros(ROWS, *leaf.shape, dtype=torch.uint8) for leaf in spec.observation if leaf.is_image]
    try:
        with torch.no_grad():
            out = module(torch.zeros(ROWS, feature_size(spec), dtype=torch.float32), *images)
    except Exception as error:
        raise UsageError(
            f"encoder {factory} raised {type(error).__name__}: {first_line(error)}; {_arguments(spec)}"
        ) from error
    if not isinstance(out, torch.Tensor) or out.dim() != 2 or len(out) != ROWS or out.dtype != torch.float32:
        got = f"{out.dtype}{list(out.shape)}" if isinstance(out, torch.Tensor) else type(out).__name__
        raise UsageError(f"encoder {factory}: expected float32[{ROWS}, K] of two observations, got {got}")
    return out.shape[1]
