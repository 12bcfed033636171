"""Advice to the author of a client that breaks a rule.

Rule: every failure names a rule of `millrace.protocol.rules`, and every rule that a check can find broken has advice here.
"""

from __future__ import annotations

from collections.abc import Mapping

from millrace.protocol.rules import Rule

MENDS: Mapping[Rule, str] = {
    Rule.FRAMES: "compare the bytes that the client sends with the table of that message, field by field",
    Rule.LIMITS: "cut texts and lists before they are sent, and send arrays in frames of their own",
    Rule.HELLO: (
        "set the DEALER's routing id to the name before connecting; draw `process_nonce` once for each process; "
        "send Hello before all else"
    ),
    Rule.ROUTING_ID: (
        "make the routing id of the name, a zero byte and the tag; decode the key from the token's base64 first, "
        "and use no other form of it"
    ),
    Rule.PROTOCOL: "write the client for the version that the wire document names, and send that number",
    Rule.HELLO_AGAIN: (
        "keep a timer while joining, and send the same Hello again when it is due: after 0.25 s, then after twice "
        "the last wait, at most 4 s"
    ),
    Rule.WELCOME_ATTEMPT: (
        "compare `attempt` of each Welcome with that of the last Hello, and ignore the message when they differ"
    ),
    Rule.REPEATED_WELCOME: "compare the session of a Welcome with the current one before anything is closed",
    Rule.REFUSE: "show the reason to the user and end the process with exit code 2",
    Rule.AFTER_REFUSE: "on Refuse, end the process without Goodbye",
    Rule.DRAIN_JOINING: "end the process with exit code 0: the run is over",
    Rule.DRAIN: (
        "on Drain, start no new work; after the work in progress send Goodbye, then end the process with exit code 0"
    ),
    Rule.STOP: "catch SIGTERM, finish the work in progress, send Goodbye, then end the process with exit code 0",
    Rule.AFTER_GOODBYE: "send Goodbye as the last message",
    Rule.JOINING_IGNORES: "look at the state before a message is handled",
    Rule.REJOIN: "on Rejoin of the current session, add 1 to `attempt` and send Hello at once",
    Rule.OTHER_SESSION: "compare the session of each message with the current one first",
    Rule.SESSION: ("take the number from the newest accepted Welcome, and drop unfinished work of the session before"),
    Rule.FORGETS: (
        "empty all that is kept by lane, ticket and version when a session ends, so that each session begins with "
        "sequence 0; if this check fails also when it runs alone (--only), look for the permit's ticket, lane and "
        "sequence"
    ),
    Rule.SILENT: (
        "note the time of the first Heartbeat after each message that arrives; `learner_timeout_s` later, join again"
    ),
    Rule.IGNORE_UNREADABLE: (
        "check the number of fields and frames of each message before it is used; log it, and do not end"
    ),
    Rule.STAYS: (
        "start the client's command by itself and look at what it prints; it must outlive lost connections, and "
        "messages that it ignores"
    ),
    Rule.CONNECTION: "let the socket connect again by itself, and keep the state of the session meanwhile",
    Rule.HEARTBEAT: "send heartbeats from a timer, or between env steps, as long as there is a session",
    Rule.HEARTBEAT_REPLIES: ("keep the largest number of a HeartbeatReply of this session, from 0, and report it"),
    Rule.LATE_REPLY: (
        "compare the number of a HeartbeatReply with the largest of this session, before its lanes are looked at"
    ),
    Rule.HEARTBEAT_TICKETS: "list a ticket from its arrival until its work is done, and no other",
    Rule.HEARTBEAT_STEPS: "count env steps of the process, not of the session",
    Rule.HEARTBEAT_VERSIONS: ("list the version of every Weights that is held, and drop all weights when a session ends"),
    Rule.HEARTBEAT_WAITS: (
        "set `waits` in each Heartbeat from the Welcome that brings a WaitSpec to the one that brings the run, and"
        " in no other"
    ),
    Rule.DESCRIBE: "answer a Describe of this session with Described, and copy its ticket",
    Rule.DESCRIBE_AGAIN: ("answer each Describe that comes, and keep the description, or make it of what does not change"),
    Rule.BEGINS: (
        "when a Welcome of the current session brings a run and none is known, begin it; the number of the last reply stays"
    ),
    Rule.ORDER_ANSWERED: "copy these four numbers from the order into the answer",
    Rule.ORDER_ONLY: (
        "send Stepped only from the code that executes an order, or that repeats the answer to an order that came again"
    ),
    Rule.ORDER_ONCE: "keep the last answer of each lane, and send it again when its ticket comes again",
    Rule.ORDER_OLD: "compare the ticket of an order with the newest of its lane",
    Rule.INCARNATION: "keep the incarnation of each lane, and compare it first",
    Rule.RESET_SOME: "reset only the listed copies, with a seed for each, and answer with the rows of all",
    Rule.OPTIONS: "unpack `options`, and give them to the environment's reset",
    Rule.STEPPED_ARRAYS: ("send dtypes and shapes as `StepSpec` and the table say; N is the number of copies of the lane"),
    Rule.AFTER_RESET: "clear reward, terminated and truncated of each copy that is reset",
    Rule.NEXT_STEP: "remember which copies have ended; their next step is a reset",
    Rule.SAME_STEP: (
        "after the step that ends an episode, reset the copy at once, without a seed; keep the reward and the "
        "flags of that step"
    ),
    Rule.DISABLED: "leave a copy whose episode has ended as it is, until a Reset names it",
    Rule.OWN_ROW: "give row n of the actions to copy n, and write what comes of it to row n of every array",
    Rule.TRUNCATED: ("count the steps of each episode; at the limit set truncated, unless the task itself ended"),
    Rule.SEEDED: "seed the environment's generator with the given seed",
    Rule.IN_SPACE: "describe the space as it is, or mend the environment",
    Rule.RETURNED: "answer every Call; a client without attributes answers with `error` set",
    Rule.RELEASE: "on Release drop the lane with its orders, tickets and rollouts",
    Rule.UNLISTED: ("compare the lanes that are held with those of each new HeartbeatReply, and drop the others"),
    Rule.LANES: "take the number of the lane from the order or permit",
    Rule.TICKETS: "take ticket and lane of a rollout from its permit",
    Rule.ROLLOUT_ONCE: (
        "keep each rollout until `received` covers its sequence, and send it only once for each Collect that names"
        " its ticket"
    ),
    Rule.RECEIVED: (
        "ignore a permit whose sequence is lower than that of its lane's next rollout, unless its rollout is kept"
    ),
    Rule.SEQUENCE: "take the sequence of a rollout from its permit",
    Rule.IN_ORDER: "keep the sequence of each lane's next rollout, and start only the permit that has it",
    Rule.VERSION: (
        "keep the version with each ticket, keep weights by version, and load those of the ticket before the rollout starts"
    ),
    Rule.HOLDS_WEIGHTS: (
        "keep weights in a map by version; when a Collect or an Evaluate comes, take its tickets, then drop the "
        "weights that neither its `keep` lists nor a ticket that is left names"
    ),
    Rule.ROWS: (
        'compare what the section "Collector profile" says of rows with what the client writes, and dtypes and '
        "shapes with the table of Rollout"
    ),
    Rule.SEATS: ('compare what "Seats" says of the rows of an agent with what the client writes, agent by agent'),
    Rule.FIRST_RESETS: "carry over which copies are to be reset first in the next rollout",
    Rule.OTHER_AGENTS: ("compare `seats` of the RunSpec with the agents of the environment, and say Goodbye if they differ"),
    Rule.LAST_OBSERVATION: (
        "do not reset a copy in the step that ends its episode: write the observation of that step, and reset in "
        "the next row"
    ),
    Rule.INDEPENDENT: (
        "seed each env copy, and its actions, with numbers of their own, made of the run's seed, the lane, the "
        "incarnation and the copy's number"
    ),
    Rule.FIRST_VALID: "carry over which copies ended in the last row of a rollout",
    Rule.CONTINUES: "keep the copies and their last observations between two rollouts of a lane",
    Rule.PAST: (
        "seed each copy by the number of its start, begin its episode from `random`, and repeat its actions from row `first`"
        " on; or do not say `continues`"
    ),
    Rule.EPISODES: (
        "add up rewards and steps of valid rows, from an episode's first step to its last, also where it began in "
        "an earlier rollout"
    ),
    Rule.EPISODE_ORDER: "go through the steps first, and through the copies in each step",
    Rule.LOG_PROB: (
        "compare the layers, their order in the flat vector and the activation function with Parameters and Acting"
        " there; sample from these same probabilities"
    ),
    Rule.ROUNDED: ("look at the dtype of `Weights.parameters`: a uint16 is shifted 16 bits up and read as float32"),
    Rule.NORMALIZED: (
        "read means and standard deviations of all features from `Weights.buffers`, and clip what comes of them"
    ),
    Rule.ATTRIBUTES: ("set these attributes in every copy of a lane before its first step under these weights, or decline"),
    Rule.EVALUATE: "play the episodes on copies of their own, under the weights of the order's version",
    Rule.CUT: "set `cut` where an episode reaches `most_steps` and neither flag is set",
    Rule.EVALUATE_SEEDS: (
        "reset the copies of an evaluation with the seeds of its order, one each, before every evaluation"
    ),
    Rule.GREEDY: (
        "look at `greedy` of each order; the most probable action is that under the weights of its `version`, "
        "which may be others than the newest"
    ),
    Rule.EPISODE_ROWS: (
        "compare dtypes, shapes and flags of EpisodeRows with its table; its reward is float64, that of a Rollout float32"
    ),
    Rule.ROWS_FIRST: (
        "send all rows of an evaluation, from step 0 of each episode to its end, and then its Evaluated; rows only"
        " if the order asks for them"
    ),
    Rule.EVALUATE_ONCE: "keep each Evaluated by its ticket, and send it when that ticket comes again",
    Rule.EVALUATE_VERSION: "look for the order's version among the weights held before the first episode",
    Rule.EVALUATE_ENDS: ("when an Evaluate comes, drop the orders with lower tickets that name another version"),
    Rule.REAPPEARS: ("draw `process_nonce` at start from a random source, not from the time or the process id"),
    Rule.DECLINED: "if the client is not meant to do this, choose the other --profile, or another --env",
    Rule.DRAINING_IGNORES: "look at the state before a message is handled",
    Rule.DRAINING_LEAVES: "end the process when one of them arrives after Drain, and say Hello no more",
}
TOO_SLOW = "look for the step at which the client waits; run this check alone with --only"
"""The advice if a check didn't end within its deadline, which isn't a rule of the wire document"""
