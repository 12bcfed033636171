"""Which checks a profile has, and in which order. Plain data."""

from __future__ import annotations

from functools import partial

from millrace.conformance import collect_checks, join_checks, step_checks
from millrace.conformance.examiner import Check

JOINING = [
    Check("says Hello first, under its own name", join_checks.says_hello),
    Check("takes a Welcome of its newest attempt only", join_checks.accepts_only_its_welcome),
    Check("ignores what belongs to no session while it is joining", join_checks.ignores_early_messages),
    Check("describes its environment, with every Heartbeat", join_checks.describes),
    Check("beats as often as heartbeat_s says", join_checks.keeps_the_rhythm),
    Check("reports the last HeartbeatReply; replies are lost, late and repeated", join_checks.answers_heartbeats_in_order),
    Check("goes on after a repeated Welcome", join_checks.takes_a_repeated_welcome),
    Check("joins again after Rejoin of its session only", join_checks.joins_again),
]
STEPPING = [
    Check("says nothing without an order", step_checks.says_nothing_without_an_order),
    Check("answers Reset and Step", step_checks.answers_reset_and_step),
    Check("ends episodes, and resets a copy in the step after", step_checks.ends_episodes),
    Check("resets a copy in the same step, or declines", partial(step_checks.resets_otherwise, mode="SameStep")),
    Check("resets no copy by itself, or declines", partial(step_checks.resets_otherwise, mode="Disabled")),
    Check("truncates an episode at the time limit", step_checks.truncates_at_the_limit),
    Check("begins the same episode for the same seed", step_checks.begins_the_same_episode_for_a_seed),
    Check("resets only the copies that a Reset lists", step_checks.resets_some_copies),
    Check("resets with options", step_checks.resets_with_options),
    Check("gives each copy its own seed and actions", step_checks.keeps_copies_apart),
    Check("executes an order once: answers are lost, orders repeated", step_checks.executes_an_order_once),
    Check("ignores a late copy of an order", step_checks.ignores_an_old_order),
    Check("ignores an order of another session", step_checks.ignores_another_session),
    Check("serves two lanes at the same time", step_checks.serves_two_lanes),
    Check("starts a lane again in a higher incarnation only", step_checks.starts_a_lane_again),
    Check("answers a Call", step_checks.answers_calls),
    Check("beats while it steps", step_checks.beats_while_it_steps),
    Check("lists no finished ticket", step_checks.lists_its_tickets),
    Check("closes a lane that is released while it is stepped", step_checks.releases_a_lane),
    Check("closes a lane that a HeartbeatReply does not list", step_checks.forgets_unlisted_lanes),
    Check("goes on after a late copy of its Welcome", step_checks.takes_a_late_welcome),
    Check("answers an order over a new connection", step_checks.answers_after_a_reset_connection),
    Check("ignores what it cannot read: extra field, missing frame, unknown type", step_checks.ignores_what_it_cannot_read),
    Check("reads messages as long as they may be", step_checks.reads_long_messages),
    Check("drains while it steps", step_checks.drains_while_it_steps),
]
FAULTS = [
    Check("keeps its session when its connection is reset", join_checks.outlives_its_connection),
    Check("joins a learner that was started again", join_checks.outlives_a_restart),
    Check("joins again when the learner falls silent", join_checks.notices_silence),
    Check("repeats Hello with backoff while its answers are lost", join_checks.repeats_hello),
    Check("draws another process_nonce in each process", join_checks.draws_its_nonce),
    Check("leaves with exit code 2 when it is refused", join_checks.leaves_when_refused),
    Check("leaves with exit code 2 when it is refused in a session", join_checks.leaves_when_refused_later),
    Check("leaves when Drain answers its Hello", join_checks.drains_while_joining),
    Check("says Goodbye after Drain, and leaves", join_checks.drains_while_idle),
    Check("says Goodbye after SIGTERM, and leaves", join_checks.stops_on_request),
    Check("leaves after SIGTERM while no learner answers", join_checks.stops_while_joining),
]
COLLECTING = [
    Check("collects rollouts of a lane", collect_checks.collects),
    Check("keeps the row format where episodes end", collect_checks.keeps_rows),
    Check("truncates an episode at the time limit", collect_checks.truncates_at_the_limit),
    Check("waits for the weights that an order names", collect_checks.waits_for_weights),
    Check("acts under the version that an order names, not under a newer one", collect_checks.acts_under_the_named_version),
    Check("holds two versions at once", collect_checks.holds_two_versions),
    Check("collects the rollouts of a lane in their order", collect_checks.collects_in_order),
    Check("lists the versions and tickets that it holds", collect_checks.lists_what_it_holds),
    Check("drops weights that no order names any more", collect_checks.drops_weights),
    Check("takes weights rounded to 16 bits", collect_checks.takes_rounded_weights),
    Check("acts by relu, and by normalized observations, or declines", collect_checks.acts_as_its_policy_says),
    Check("sets attributes of its environments", collect_checks.sets_attributes),
    Check("keeps the weights of a rollout in progress", collect_checks.keeps_its_weights),
    Check("sends a lost rollout again, the same", collect_checks.sends_again),
    Check("sends a rollout once", collect_checks.says_no_rollout_twice),
    Check("ignores a late Collect of a rollout that has arrived", collect_checks.forgets_what_arrived),
    Check("collects two lanes, and two tickets of one", collect_checks.collects_two_lanes),
    Check("starts a lane again in a higher incarnation only", collect_checks.starts_a_lane_again),
    Check("closes a lane that is released while a ticket waits", collect_checks.releases_a_lane),
    Check("closes a lane that a HeartbeatReply does not list", collect_checks.closes_unlisted_lanes),
    Check("ignores late copies of a HeartbeatReply", collect_checks.ignores_a_late_reply),
    Check("forgets the session before", collect_checks.forgets_the_session_before),
    Check("collects over a new connection", collect_checks.collects_over_a_new_connection),
    Check("ignores what it cannot read", collect_checks.ignores_what_it_cannot_read),
    Check("beats while it collects", collect_checks.beats_while_it_collects),
    Check("evaluates", collect_checks.evaluates),
    Check("evaluates under the version that is asked for", collect_checks.evaluates_one_version),
    Check("evaluates with rows, or declines", collect_checks.evaluates_with_rows),
    Check("evaluates under no other version, or declines rows", collect_checks.evaluates_under_no_other_version),
    Check("ends an evaluation when a later one comes", collect_checks.ends_evaluations),
    Check("drains while it collects", collect_checks.drains_while_it_collects),
    Check("takes no work while it drains", collect_checks.takes_no_work_while_it_drains),
    Check("leaves when it is refused while it drains", collect_checks.leaves_when_refused_while_it_drains),
    Check("leaves when it is told to join again while it drains", collect_checks.leaves_when_unknown_while_it_drains),
]
PROFILES: dict[str, tuple[Check, ...]] = {
    "environment": (*JOINING, *STEPPING, *FAULTS),
    "collector": (*JOINING, *COLLECTING, *FAULTS),
}
