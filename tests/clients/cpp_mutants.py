"""Mistakes in the C++ client: a table of changes to its source, and what `millrace conform` says of each.

Rule: a mutant is one change of one header, a mistake that an author of a client makes.
"""

from __future__ import annotations

from typing import NamedTuple

from millrace.extras.conformance import rules
from millrace.extras.conformance.rules import Rule


class Mutant(NamedTuple):
    """A mistake, the check that catches it, and what the report says."""

    name: str
    header: str
    """in clients/cpp/include/millrace"""
    old: str
    """stands there exactly once"""
    new: str
    """stands there instead"""
    profile: str
    check: str
    """part of its name"""
    rule: Rule
    """the rule that the report names"""
    got: str
    """part of what the report says was got"""
    program: str = "cartpole"
    """in clients/cpp/examples or clients/cpp/tests"""


# fmt: off
MUTANTS = [
    Mutant(
        "stale session", "session.hpp",
        "session_ = *m.session, run_",
        "session_ += session_ ? 0 : *m.session, run_",
        "environment", "joins again after Rejoin", rules.SESSION, "Described(session",
    ),
    Mutant(
        "stale attempt", "session.hpp",
        "    ++attempt_;\n",
        "    attempt_ = process_nonce_ + 1;\n",
        "environment", "joins again after Rejoin", rules.REJOIN, "attempt",
    ),
    Mutant(
        "late rejoin", "session.hpp",
        "    begin_to_join();\n"
        "    tick(now_s());",
        "    begin_to_join();\n"
        "    due_s_ += 20;",
        "environment", "joins again after Rejoin", rules.REJOIN, "none within",
    ),
    Mutant(
        "same process_nonce in every process", "session.hpp",
        "(std::uint64_t(random()) << 32 | random()) >> 16",
        "7",
        "environment", "draws another process_nonce", rules.REAPPEARS, "the same",
    ),
    Mutant(
        "begins again at a repeated Welcome", "session.hpp",
        " || (state_ == State::ready && *m.session == session_)",
        "",
        "environment", "late copy of its Welcome", rules.REPEATED_WELCOME, "another observation",
    ),
    Mutant(
        "oversized text", "session.hpp",
        "\"millrace C++ client\"",
        "std::string(2000, 'x')",
        "environment", "says Hello first", rules.LIMITS, "software",
    ),
    Mutant(
        "forgotten heartbeat", "session.hpp",
        "due_s_ = now + run_.heartbeat_s;",
        "due_s_ = now + 60;",
        "environment", "beats as often as", rules.HEARTBEAT, "none",
    ),
    Mutant(
        "late copies of a reply count", "session.hpp",
        "if (m.number <= replies_) return;",
        "",
        "environment", "last HeartbeatReply", rules.HEARTBEAT_REPLIES, "4",
    ),
    Mutant(
        "steps counted by session", "session.hpp",
        "replies_ = 0;\n    heard_s_",
        "replies_ = 0, steps_ = 0;\n    heard_s_",
        "environment", "ignores an order of another session", rules.HEARTBEAT_STEPS, "0",
    ),
    Mutant(
        "obeys another session", "session.hpp",
        "state_ == State::joining || (m.session && *m.session != session_)",
        "state_ == State::joining",
        "environment", "an order of another session", rules.OTHER_SESSION, "Stepped(",
    ),
    Mutant(
        "ends on what it cannot read", "session.hpp",
        "catch (const BadMessage& error) {",
        "catch (const BadMessage& error) {\n"
        "        leave(3, error.what());",
        "environment", "ignores what it cannot read", rules.STAYS, "exit code 3",
    ),
    Mutant(
        "ignores Drain", "session.hpp",
        "draining ? void() : drain(m.text, false);",
        "void();",
        "environment", "says Goodbye after Drain", rules.DRAIN, "none within",
    ),
    Mutant(
        "refusal is no error", "session.hpp",
        "return leave(2, m.text);",
        "return leave(0, m.text);",
        "environment", "exit code 2 when it is refused", rules.REFUSE, "exit code 0",
    ),
    Mutant(
        "drained is an error", "session.hpp",
        "    leave(0, reason_);",
        "    leave(1, reason_);",
        "environment", "says Goodbye after Drain", rules.DRAIN, "exit code 1",
    ),
    Mutant(
        "leaves without Goodbye after SIGTERM", "session.hpp",
        "drain(\"it was told to stop\", true)",
        "leave(0, \"it was told to stop\")",
        "environment", "Goodbye after SIGTERM", rules.STOP, "without Goodbye",
    ),
    Mutant(
        "wrong dtype", "worker.hpp",
        ".described(\"<f8\", 2, {N})",
        ".described(\"<i8\", 2, {N})",
        "environment", "answers Reset and Step", rules.STEPPED_ARRAYS, "reward: expected float64",
    ),
    Mutant(
        "wrong frame", "worker.hpp",
        "{lane.reward.data(), 8 * N}",
        "{lane.reward.data(), 4 * N}",
        "environment", "answers Reset and Step", rules.FRAMES, "",
    ),
    Mutant(
        "wrong incarnation", "worker.hpp",
        ".natural(m.lane).natural(lane.incarnation)",
        ".natural(m.lane).natural(0)",
        "environment", "starts a lane again", rules.INCARNATION, "incarnation 0",
    ),
    Mutant(
        "obeys a lower incarnation", "worker.hpp",
        "if (order < newest) return;",
        "if (order < newest && m.incarnation == lane.incarnation) return;",
        "environment", "starts a lane again", rules.INCARNATION, "incarnation 2",
    ),
    Mutant(
        "wrong ticket", "worker.hpp",
        "\"Stepped\", 9).natural(session_).natural(lane.ticket)",
        "\"Stepped\", 9).natural(session_).natural(lane.ticket - 1)",
        "environment", "answers Reset and Step", rules.ORDER_ONLY, "ticket",
    ),
    Mutant(
        "executes a repeated order again", "worker.hpp",
        "return lane.answered && m.type != Type::Call ? answer(m, lane) : void();",
        "{}",
        "environment", "executes an order once", rules.ORDER_ONCE, "",
    ),
    Mutant(
        "obeys an old order", "worker.hpp",
        "if (order < newest) return;",
        "if (m.incarnation < lane.incarnation) return;",
        "environment", "ignores a late copy of an order", rules.ORDER_OLD, "Stepped(",
    ),
    Mutant(
        "missing truncated", "worker.hpp",
        "lane.truncated[n] = result.truncated;",
        "lane.truncated[n] = 0;",
        "environment", "truncates an episode", rules.TRUNCATED, "no end after 500 steps",
    ),
    Mutant(
        "steps a copy that has ended", "worker.hpp",
        "(lane.terminated[n] || lane.truncated[n]) && run_.autoreset == \"NextStep\"",
        "false",
        "environment", "ends episodes", rules.NEXT_STEP, "reward 1",
    ),
    Mutant(
        "forgotten final observation", "worker.hpp",
        "          lane.envs[n]->reset(std::nullopt, &lane.obs[n * bytes]);\n"
        "          lane.reward[n] = 0, lane.terminated[n] = lane.truncated[n] = 0;\n"
        "        } else {\n"
        "          Result result = lane.envs[n]->step({action}, &lane.obs[n * bytes]);\n",
        "          lane.reward[n] = 0, lane.terminated[n] = lane.truncated[n] = 0;\n"
        "        } else {\n"
        "          Result result = lane.envs[n]->step({action}, &lane.obs[n * bytes]);\n"
        "          if (result.terminated) lane.envs[n]->reset(std::nullopt, &lane.obs[n * bytes]);\n",
        "environment", "ends episodes", rules.NEXT_STEP, "the same observation in both",
    ),
    Mutant(
        "one seed for all copies", "worker.hpp",
        "reset(m.seeds[i], &lane",
        "reset(m.seeds[0], &lane",
        "environment", "own seed and actions", rules.SEEDED, "another",
    ),
    Mutant(
        "one action for all copies", "worker.hpp",
        "++n, action += description_.action.bytes()",
        "++n",
        "environment", "own seed and actions", rules.OWN_ROW, "another",
    ),
    Mutant(
        "rows in another order", "worker.hpp",
        "Result result = lane.envs[n]->step(",
        "Result result = lane.envs[lane.envs.size() - 1 - n]->step(",
        "environment", "own seed and actions", rules.OWN_ROW, "another",
    ),
    Mutant(
        "resets all copies", "worker.hpp",
        "std::size_t n = m.copies[i];\n",
        "std::size_t n = m.copies[i];\n"
        "        for (std::size_t k = 0; k < lane.envs.size(); ++k)\n"
        "          lane.envs[k]->reset(m.seeds[i], &lane.obs[k * bytes]);\n",
        "environment", "only the copies that a Reset lists", rules.RESET_SOME, "others",
    ),
    Mutant(
        "missing truncated", "rollouts.hpp",
        "r.truncated[i] = truncated",
        "r.truncated[i] = 0",
        "collector", "truncates an episode", rules.ROWS, "valid: expected",
    ),
    Mutant(
        "forgotten final observation", "rollouts.hpp",
        "std::copy(r.obs.end() - static_cast<std::ptrdiff_t>(obs.size()), r.obs.end(), obs.begin());",
        "",
        "collector", "collects rollouts", rules.CONTINUES, "another observation",
    ),
    Mutant(
        "rows in another order", "rollouts.hpp",
        "return &r.log_prob[r.rows * C + c];",
        "return &r.log_prob[c * T + r.rows];",
        "collector", "collects rollouts", rules.LOG_PROB, "",
    ),
    Mutant(
        "wrong episode length", "seats.hpp",
        "else ++episodes_[n].length;",
        "else episodes_[n].length = 1;",
        "collector", "keeps the row format", rules.EPISODES, "",
    ),
    Mutant(
        "wrong layout of weights", "policy.hpp",
        "layer.weight[i * layer.outputs + o] = *next++",
        "layer.weight[o * layer.inputs + i] = *next++",
        "collector", "collects rollouts", rules.LOG_PROB, "-",
    ),
    Mutant(
        "bfloat16 read as a number", "policy.hpp",
        "std::uint32_t(half) << 16",
        "std::uint32_t(half)",
        "collector", "weights rounded to 16 bits", rules.ROUNDED, "",
    ),
    Mutant(
        "repeated rollout", "rollouts.hpp",
        "    send_rollout(*rollout);\n"
        "    held.kept",
        "    send_rollout(*rollout), send_rollout(*rollout);\n"
        "    held.kept",
        "collector", "sends a rollout once", rules.ROLLOUT_ONCE, "2 answers",
    ),
    Mutant(
        "ignores a repeated ticket", "rollouts.hpp",
        "for (const auto& rollout : held.kept) if (rollout->ticket == permit.ticket) return send_rollout(*rollout);",
        "",
        "collector", "sends a lost rollout again", rules.ROLLOUT_ONCE, "none within",
    ),
    Mutant(
        "takes a finished ticket again", "rollouts.hpp",
        "if (permit.sequence >= held.sequence) held",
        "held",
        "collector", "late Collect", rules.HEARTBEAT_TICKETS, "which was answered",
    ),
    Mutant(
        "wrong sequence", "rollouts.hpp",
        "rollout->sequence = held.sequence;",
        "rollout->sequence = held.sequence + 1;",
        "collector", "collects rollouts", rules.SEQUENCE, "sequence 1",
    ),
    Mutant(
        "obeys a lower incarnation", "rollouts.hpp",
        "if (permit.incarnation < held.incarnation) return;",
        "",
        "collector", "starts a lane again", rules.INCARNATION, "Rollout(",
    ),
    Mutant(
        "does not wait for weights", "rollouts.hpp",
        "if (permitted.sequence == held.sequence && weights_.count(permitted.version))\n"
        "          first = std::min(first, {permitted.version, ticket, number});",
        "if (permitted.sequence == held.sequence && !weights_.empty())\n"
        "          first = std::min(first, {weights_.rbegin()->first, ticket, number});",
        "collector", "waits for the weights", rules.VERSION, "version 1",
    ),
    Mutant(
        "acts under the newest weights", "rollouts.hpp",
        "load(version);\n"
        "    std::unique_ptr",
        "load_newest();\n"
        "    std::unique_ptr",
        "collector", "acts under the version", rules.LOG_PROB, "",
    ),
    Mutant(
        "holds the last weights only", "rollouts.hpp",
        "if (!weights_.count(m.version)) weights_.emplace(",
        "if (!weights_.count(m.version)) weights_.clear(), weights_.emplace(",
        "collector", "holds two versions", rules.HOLDS_WEIGHTS, "none within",
    ),
    Mutant(
        "collects in the order of tickets", "rollouts.hpp",
        "permitted.sequence == held.sequence && weights_",
        "weights_",
        "collector", "in their order", rules.SEQUENCE, "sequence 1",
    ),
    Mutant(
        "lists the newest weights only", "rollouts.hpp",
        "listed_versions_.push_back(version);",
        "listed_versions_.assign(1, version);",
        "collector", "lists the versions", rules.HEARTBEAT_VERSIONS, "none within",
    ),
    Mutant(
        "keeps all weights", "rollouts.hpp",
        "return std::find(m.keep.begin(), m.keep.end(), version) != m.keep.end();",
        "return version > 0;",
        "collector", "keeps the weights", rules.HOLDS_WEIGHTS, "[1, 2, 3]",
    ),
    Mutant(
        "keeps only what its tickets name", "rollouts.hpp",
        "return std::find(m.keep.begin(), m.keep.end(), version) != m.keep.end();",
        "return false;",
        "collector", "keeps the weights", rules.HOLDS_WEIGHTS, "[2]",
    ),
    Mutant(
        "other weights in the middle of a rollout", "rollouts.hpp",
        "weights_.emplace(m.version, policy_.weights(m));",
        "weights_.emplace(m.version, policy_.weights(m)), load_newest();",
        "collector", "keeps the weights of a rollout", rules.LOG_PROB, "",
    ),
    Mutant(
        "keeps the tickets of the session before", "rollouts.hpp",
        "void end_collecting() { held_.clear(), ",
        "void end_collecting() { ",
        "collector", "forgets the session before", rules.HEARTBEAT_TICKETS, "ticket",
    ),
    Mutant(
        "the same random numbers in every lane", "policy.hpp",
        "state_ = bits() ^ each;",
        "state_ = each & 0;",
        "collector", "collects two lanes", rules.INDEPENDENT, "copy 0 of lane 0 in copy",
    ),
    Mutant(
        "forgets an end between two rollouts", "worker.hpp",
        "for (rows.begin(*rollout);;) {",
        "for (SeatedCopy& copy : lane->copies) copy.seats[0].acts = true;\n"
        "      rows.resets.assign(rows.N, 0);\n"
        "      for (rows.begin(*rollout);;) {",
        "collector", "keeps the row format", rules.FIRST_VALID, "True",
    ),
    Mutant(
        "forgotten final observation of an episode", "worker.hpp",
        "env_->reset(seed, seats[0].obs), seats[0].acts = true; }\n"
        "  void step(const std::vector<Action>& actions, std::vector<Seat>& seats) override {\n"
        "    const Result result = env_->step(actions[0], seats[0].obs);\n",
        "if (seed) env_->reset(seed, seats[0].obs);\n"
        "    seats[0].acts = true;\n"
        "  }\n"
        "  void step(const std::vector<Action>& actions, std::vector<Seat>& seats) override {\n"
        "    const Result result = env_->step(actions[0], seats[0].obs);\n"
        "    if (result.terminated) env_->reset(std::nullopt, seats[0].obs);\n",
        "collector", "keeps the row format", rules.LAST_OBSERVATION, "the first one",
    ),
    Mutant(
        "an episode more", "worker.hpp",
        "evaluation.episodes.push_back(episode);",
        "evaluation.episodes.insert(evaluation.episodes.end(), 2, episode);",
        "collector", "evaluates", rules.EVALUATE, "4",
    ),
    Mutant(
        "ignores Release", "session.hpp",
        "for (const LaneIncarnation& lane : m.lanes) release(lane.lane, lane.incarnation);",
        "",
        "collector", "is released while", rules.RELEASE, "Rollout(",
    ),
    Mutant(
        "keeps an unlisted lane", "session.hpp",
        "release(lane, std::numeric_limits<std::uint64_t>::max());",
        "{}",
        "collector", "does not list", rules.UNLISTED, "Rollout(",
    ),
    Mutant(
        "takes work while it drains", "session.hpp",
        "default: if (draining) return;",
        "default: break;",
        "collector", "no work while it drains", rules.DRAINING_IGNORES, "",
    ),
    Mutant(
        "Goodbye without tickets", "session.hpp",
        "for (std::uint64_t ticket : tickets()) w.natural(ticket);\n"
        "    link_.send(head_);",
        "head_.begin(\"Goodbye\", 3).natural(session_).text(line(why)).array(0);\n"
        "    link_.send(head_);",
        "collector", "drains while it collects", rules.DRAIN, "[]",
    ),
    Mutant(
        "evaluates without end", "worker.hpp",
        " && episode.length < evaluation.most_steps",
        "",
        "collector", "evaluates", rules.CUT, "steps",
    ),
    Mutant(
        "evaluates again", "rollouts.hpp",
        "for (const Evaluation& answer : answers_) if (answer.ticket == m.ticket) return send_evaluation(answer);",
        "",
        "collector", "evaluates", rules.EVALUATE_ONCE, "another",
    ),
    Mutant(
        "goes on with an evaluation that is over", "rollouts.hpp",
        "orders_.erase(std::remove_if(orders_.begin(), orders_.end(), over), orders_.end());",
        "(void)over;",
        "collector", "ends an evaluation", rules.EVALUATE_ENDS, "ticket",
    ),
    Mutant(
        "rows of a seat that waits", "seats.hpp",
        "write(r, c, complete, complete ?",
        "write(r, c, true, complete ?",
        "collector", "collects rollouts", rules.SEATS, "valid: expected none", "gathering",
    ),
    Mutant(
        "forgets who is reset first", "seats.hpp",
        "std::copy(resets.begin(), resets.end(), r.resets.begin());",
        "std::fill(r.resets.begin(), r.resets.end(), 0);",
        "collector", "keeps the row format", rules.FIRST_RESETS, "False", "tag",
    ),
    Mutant(
        "forgets what a seat that waits did", "seats.hpp",
        "*log_prob_at(r, c) = columns_[c].log_prob;",
        "*log_prob_at(r, c) = 0;",
        "collector", "collects rollouts", rules.LOG_PROB, "0.00000", "nim",
    ),
    Mutant(
        "a return of one seat", "seats.hpp",
        "episode.reward += columns_[c].total,",
        "episode.reward = columns_[c].total,",
        "collector", "keeps the row format", rules.EPISODES, "", "tag",
    ),
    Mutant(
        "steps that only reset count", "seats.hpp",
        "if (resets[n]) begin_episode(n, now);\n"
        "    else ++",
        "if (resets[n]) begin_episode(n, now);\n"
        "    ++",
        "collector", "keeps the row format", rules.EPISODES, "", "tag",
    ),
    Mutant(
        "serves any agents", "rollouts.hpp",
        "if (run.seats == description_.seats && (run.takes_turns || !description_.takes_turns)) return \"\";",
        "return \"\";",
        "collector", "of agents", rules.OTHER_AGENTS, "none within", "tag",
    ),
]
# fmt: on
