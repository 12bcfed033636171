"""`millrace conform`: its flags, and the report that it prints."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from millrace.extras.conformance.conform import ClientCommand, conform
from millrace.extras.conformance.examiner import Check, CheckResult
from millrace.extras.conformance.learner import Settings
from millrace.extras.conformance.profiles import PROFILES
from millrace.extras.conformance.report import as_data, explanation, line_of, summary
from millrace.flags.fields import Flag, Positive
from millrace.flags.parse import cut_at_dashes, parse_flags
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import UsageError


class ConformFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Check a client, which is a worker in any language, with `millrace conform [flags] -- COMMAND`.

    Plays the learner on a port of this machine, starts COMMAND, and walks it through the messages, states and faults of the
    wire document. In COMMAND, {address} stands for the address to connect to, and {token} for a file with the join token;
    the environment variables MILLRACE_ADDRESS and MILLRACE_TOKEN have the same values. Exit code 0: the client conforms; 1:
    it does not.
    """

    profile: Literal["collector", "environment"] = "environment"
    """environment: the learner acts, the client resets and steps its copies; collector: the client acts, with the weights
    that it is sent
    """
    env: Annotated[str, Flag("ID")] = "CartPole-v1"
    """the environment that the client is asked for"""
    copies: Annotated[int, Meta(ge=1)] = 2
    """env copies in a lane"""
    only: str = ""
    """run only the checks whose name contains TEXT"""
    json: Annotated[str, Flag("FILE")] = ""
    """also write the report to FILE, as JSON"""
    with_keys: bool = False
    """encrypt the connection; {token} in COMMAND has the same effect"""
    patience_s: Positive = 5.0
    """seconds that an answer of the client may take"""
    start_s: Positive = 20.0
    """seconds that the client may take to start"""
    limit_s: Positive = 300.0
    """seconds that the whole test may take"""


def run(argv: list[str]) -> int:
    """Check the client and print the report. Returns the exit code."""
    return check(argv, lambda line: print(line, flush=True))


def check(argv: list[str], write: Callable[[str], None]) -> int:
    """Check the client. `write` is called with the lines of the report. Returns the exit code."""
    words, command = cut_at_dashes(argv)
    values = parse_flags(ConformFlags, words, "conform")
    if not command:
        raise UsageError(
            "conform: which client? expected its command after --, as in: millrace conform -- ./client {address}"
        )
    checks = _chosen(PROFILES[values.profile], values.only)
    settings = Settings(EnvSpec(values.env), copies=values.copies, patience_s=values.patience_s, start_s=values.start_s)
    results: list[CheckResult] = []

    def watch(result: CheckResult) -> None:
        write("\n".join([line_of(result), *explanation(result, results)]))
        results.append(result)

    about = f"profile {values.profile}, {values.env}, {values.copies} copies in a lane, {len(checks)} checks"
    write(f"{about}: {' '.join(command)}")
    conform(ClientCommand(tuple(command), values.with_keys), checks, settings, values.limit_s, watch)
    write(summary(results))
    if values.json:
        report = json.dumps(as_data(results, values.profile, command), indent=2, ensure_ascii=False)
        try:
            Path(values.json).write_text(report + "\n", "utf-8", "surrogateescape")
        except OSError as error:
            raise UsageError(f"conform: report {values.json} not written: {error.strerror}") from error
    return int(any(result.outcome == "failed" for result in results))


def _chosen(checks: Sequence[Check], only: str) -> list[Check]:
    chosen = [check for check in checks if only in check.name]
    if not chosen:
        raise UsageError(f"conform: --only {only}: expected a part of the name of a check, as in: {checks[0].name}")
    return chosen
