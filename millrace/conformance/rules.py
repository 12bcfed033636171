"""The rules of the wire document that a client is checked against, in its words, and what a client's author does next.

Rule: every failure names one of these. `section` is a heading of protocol/README.md.
"""

from __future__ import annotations

from dataclasses import dataclass

DOCUMENT = "protocol/README.md"


@dataclass(frozen=True)
class Rule:
    """One rule of the wire document."""

    section: str
    """heading of protocol/README.md"""
    text: str
    """the rule, in the document's words"""
    mend: str
    """what the author of a client that breaks it does next"""


FRAMES = Rule(
    "Frames",
    "Frame 0 is one msgpack array: the name of the message's type, then its fields in order. All fields must be "
    "present and nothing more. The head names every frame once, and the frame's length matches dtype and shape",
    "compare the bytes that the client sends with the table of that message, field by field",
)
LIMITS = Rule(
    "Limits",
    "A message stays within the limits: bytes of the head, frames of a message, items of a list, characters of a text",
    "cut texts and lists before they are sent, and send arrays in frames of their own",
)
HELLO = Rule(
    "Messages, Hello",
    "A worker's first message is Hello, a map with protocol, worker, host, pid, life, software and attempt; `worker` "
    "is also its routing id, and `attempt` is `life` + 1 when the process first joins",
    "set the DEALER's routing id to the name before connecting; draw `life` once for each process; send Hello before "
    "all else",
)
PROTOCOL = Rule(
    "How it may evolve",
    "Both sides speak exactly one version, which Hello names",
    "write the client for the version that the wire document names, and send that number",
)
HELLO_AGAIN = Rule(
    "Messages, Hello",
    "Hello is repeated with backoff until it is answered: after 0.25 s, then each wait is twice as long as the last, "
    "at most 4 s. A repeated Hello keeps `attempt`",
    "keep a timer while joining, and send the same Hello again when it is due",
)
WELCOME_ATTEMPT = Rule(
    "The worker's half",
    "A worker accepts a Welcome only if `attempt` is its newest",
    "compare `attempt` of each Welcome with that of the last Hello, and ignore the message when they differ",
)
REPEATED_WELCOME = Rule(
    "The worker's half",
    "In the state ready, a repeated Welcome of the same session changes nothing",
    "compare the session of a Welcome with the current one before anything is closed",
)
REFUSE = Rule(
    "The worker's half",
    "Refuse: the worker leaves, with exit code 2, in every state",
    "show the reason to the user and end the process with exit code 2",
)
DRAIN_JOINING = Rule(
    "The worker's half",
    "Drain while joining: the worker leaves",
    "end the process with exit code 0: the run is over",
)
DRAIN = Rule(
    "The worker's half",
    "Drain while ready: the worker finishes its work in progress, sends it, says Goodbye with the tickets that it did"
    " not finish, and leaves",
    "on Drain, start no new work; after the work in progress send Goodbye, then end the process with exit code 0",
)
STOP = Rule(
    "The worker's half",
    "StopRequested (SIGTERM): as Drain; the worker finishes its work in progress, says Goodbye and leaves",
    "catch SIGTERM, finish the work in progress, send Goodbye, then end the process with exit code 0",
)
AFTER_GOODBYE = Rule(
    "The worker's half",
    "In the state left, a worker says nothing more",
    "send Goodbye as the last message",
)
JOINING_IGNORES = Rule(
    "The worker's half",
    "While joining, every message but Welcome, Refuse and Drain is ignored",
    "look at the state before a message is handled",
)
REJOIN = Rule(
    "The worker's half",
    "Rejoin while ready: the worker is joining again, and says Hello with a later `attempt`",
    "on Rejoin of the current session, add 1 to `attempt` and send Hello at once",
)
OTHER_SESSION = Rule(
    "The worker's half",
    "A worker ignores a message of another session in every state",
    "compare the session of each message with the current one first",
)
SESSION = Rule(
    "Words",
    "The session of the Welcome stands in every later message of the session; when a session ends, the worker forgets"
    " its env copies, tickets, rollouts and weights",
    "take the number from the newest accepted Welcome, and drop unfinished work of the session before",
)
SILENT = Rule(
    "The worker's half",
    "LearnerSilent: when no message of the learner has followed a Heartbeat for `learner_timeout_s`, the worker says Hello "
    "again with a later `attempt`; any message counts as a sign of life",
    "note the time of the first Heartbeat after each message that arrives; `learner_timeout_s` later, join again",
)
IGNORE_UNREADABLE = Rule(
    "Frames",
    "A worker ignores a message that it cannot read, or whose fields are not exactly those of the table, and goes on",
    "check the number of fields and frames of each message before it is used; log it, and do not end",
)
STAYS = Rule(
    "The worker's half",
    "A worker leaves after Refuse, after Drain, when it is asked to stop, or when it fails; else it stays",
    "start the client's command by itself and look at what it prints; it must outlive lost connections, and messages that "
    "it ignores",
)
CONNECTION = Rule(
    "Transport",
    "All rules hold even if messages of any type are lost: a session outlives its connection",
    "let the socket connect again by itself, and keep the state of the session meanwhile",
)
HEARTBEAT = Rule(
    "Messages, Heartbeat",
    "A worker in a session sends a Heartbeat every `heartbeat_s`, also while its environment works",
    "send heartbeats from a timer, or between env steps, as long as there is a session",
)
HEARTBEAT_REPLIES = Rule(
    "The heartbeat repairs",
    "`replies` is the number of the last HeartbeatReply received. A reply whose number is not larger than that of the"
    " last one is a late copy, and is ignored",
    "keep the largest number of a HeartbeatReply of this session, from 0, and report it",
)
HEARTBEAT_TICKETS = Rule(
    "Messages, Heartbeat",
    "`tickets` lists the tickets that are held and not finished, of this session and of the worker's own lanes",
    "list a ticket from its arrival until its work is done, and no other",
)
HEARTBEAT_STEPS = Rule(
    "Messages, Heartbeat",
    "`steps` counts the env steps since the worker started: it never falls",
    "count env steps of the process, not of the session",
)
HEARTBEAT_VERSIONS = Rule(
    "Messages, Heartbeat",
    "`versions` lists the weights held, ascending; with each session it begins empty",
    "list the version of every Weights that is held, and drop all weights when a session ends",
)
DESCRIBE = Rule(
    "Describe",
    "A worker that is welcomed with a DescribeSpec makes one env copy, sends Described, and closes the copy",
    "answer a Welcome whose run has the type DescribeSpec with Described",
)
DESCRIBE_AGAIN = Rule(
    "Describe",
    "Described is repeated with every Heartbeat, because a message may be lost",
    "keep the description until the session ends, and send it after each Heartbeat",
)
ORDER_ANSWERED = Rule(
    "Messages, Reset and Step",
    "A Reset or a Step is answered by Stepped, with the session, ticket, lane and incarnation of the order",
    "copy these four numbers from the order into the answer",
)
ORDER_ONLY = Rule(
    "Messages, Reset and Step",
    "Stepped and Returned answer an order, and are sent for nothing else; an order is answered once for each time "
    "that it arrives",
    "send Stepped only from the code that executes an order, or that repeats the answer to an order that came again",
)
ORDER_ONCE = Rule(
    "Messages, Reset",
    "Tickets rise with every order. An order is executed once, and answered again, with the same answer, if it is repeated",
    "keep the last answer of each lane, and send it again when its ticket comes again",
)
ORDER_OLD = Rule(
    "Messages, Reset",
    "Tickets rise with every order: an order with a smaller ticket than the last one of its lane is a late copy and "
    "is ignored",
    "compare the ticket of an order with the newest of its lane",
)
INCARNATION = Rule(
    "The worker's half",
    "A higher incarnation starts the lane again, on new env copies; an order or permit of a lower one is ignored",
    "keep the incarnation of each lane, and compare it first",
)
RESET_SOME = Rule(
    "Messages, Reset",
    "Reset starts episodes in the copies that it lists, and leaves the others as they are; Stepped has a row for every copy",
    "reset only the listed copies, with a seed for each, and answer with the rows of all",
)
STEPPED_ARRAYS = Rule(
    "Messages, Stepped",
    "obs has one array [N, *leaf] for each leaf in its dtype; reward is [N] float64; terminated and truncated are [N]"
    " bool; infos is [bytes] uint8",
    "send dtypes and shapes as `StepSpec` and the table say; N is the number of copies of the lane",
)
AFTER_RESET = Rule(
    "Messages, Reset",
    "A copy that was reset has reward 0, and neither flag",
    "clear reward, terminated and truncated of each copy that is reset",
)
NEXT_STEP = Rule(
    "Records inside messages, StepSpec",
    "With autoreset NextStep, the step after an episode's end ignores the action and only resets that copy: reward 0,"
    " neither flag, and the first observation of the next episode",
    "remember which copies have ended; their next step is a reset",
)
OWN_ROW = Rule(
    "Environment profile",
    "Row n of every array is that of copy n, in actions and in answers",
    "give row n of the actions to copy n, and write what comes of it to row n of every array",
)
TRUNCATED = Rule(
    "Messages, Rollout and Stepped",
    "truncated: a time limit ended the episode. An episode is at most `longest_episode` steps long",
    "count the steps of each episode; at the limit set truncated, unless the task itself ended",
)
SEEDED = Rule(
    "Messages, Reset",
    "`seeds` has the reset seed of each copy: the same seed begins the same episode",
    "seed the environment's generator with the given seed",
)
IN_SPACE = Rule(
    "Records inside messages, EnvDescription",
    "`observation` describes the arrays of an observation: observations are within its bounds, and finite",
    "describe the space as it is, or mend the environment",
)
RETURNED = Rule(
    "Messages, Call",
    "A Call is answered by Returned: one result for each copy, or the exception's type and message in `error`",
    "answer every Call; a client without attributes answers with `error` set",
)
RELEASE = Rule(
    "Messages, Release",
    "Release: these lanes belong to other workers now. The worker closes them, drops their tickets, and sends nothing"
    " of them",
    "on Release drop the lane with its orders, tickets and rollouts",
)
UNLISTED = Rule(
    "The worker's half",
    "The worker closes a lane that the `received` of a HeartbeatReply does not list",
    "compare the lanes that are held with those of each new HeartbeatReply, and drop the others",
)
LANES = Rule(
    "Words",
    "A worker works only for lanes that it was given, each in its newest incarnation",
    "take the number of the lane from the order or permit",
)
TICKETS = Rule(
    "The worker's half",
    "A ticket is permission for one rollout: a rollout carries the ticket, lane and incarnation of a permit that is held",
    "take ticket and lane of a rollout from its permit",
)
ROLLOUT_ONCE = Rule(
    "The worker's half",
    "A ticket is collected once. The rollout is sent again, the same, only if the learner asks for that ticket again",
    "keep each rollout until `received` covers its sequence, and send it only once for each Collect that names its ticket",
)
RECEIVED = Rule(
    "The worker's half",
    "The worker keeps a rollout until `received` says that it has arrived. After that, a late repeat of its Collect is "
    "ignored",
    "ignore a permit whose sequence is lower than that of its lane's next rollout, unless its rollout is kept",
)
SEQUENCE = Rule(
    "Words",
    "`sequence` is the number of the rollout within this lane and incarnation, from 0, as its permit says",
    "take the sequence of a rollout from its permit",
)
IN_ORDER = Rule(
    "The worker's half",
    "The rollouts of a lane are collected in the order of `Permit.sequence`, from 0 in every incarnation. A permit waits "
    "for those before it",
    "keep the sequence of each lane's next rollout, and start only the permit that has it",
)
VERSION = Rule(
    "The worker's half",
    "A rollout is collected under exactly the version that its Collect names, also if newer weights have come. It waits "
    "until these weights are held",
    "keep the version with each ticket, keep weights by version, and load those of the ticket before the rollout starts",
)
HOLDS_WEIGHTS = Rule(
    "The worker's half",
    "The worker holds the newest weights that have come, and those that an unfinished ticket names. It drops all others "
    "when a piece of work ends",
    "keep weights in a map by version; after each rollout or evaluation drop those that are neither the newest nor named by "
    "a ticket that is left",
)
ROWS = Rule(
    "Messages, Rollout",
    "The arrays of a rollout have the shapes and dtypes of the table, finite values, actions of the space, and "
    "valid[t+1] == not (terminated[t] or truncated[t])",
    "write the rows as docs/explanation/rows.md says",
)
LAST_OBSERVATION = Rule(
    "Collector profile",
    "The row after the end of an episode only resets that copy: its observation is the last one of the old episode, "
    "obs[t+1] the first one of the new",
    "do not reset a copy in the step that ends its episode: write the observation of that step, and reset in the next row",
)
INDEPENDENT = Rule(
    "Records inside messages, RunSpec",
    "Env copies and action generators are seeded by (seed, lane, incarnation, …): no copy repeats what another one does",
    "seed each env copy with a number of its own, made of the run's seed, the lane, the incarnation and the copy's number",
)
FIRST_VALID = Rule(
    "Messages, Rollout",
    "valid is False on the row in which a finished copy is reset, also when that is the first row of the next rollout",
    "carry over which copies ended in the last row of a rollout",
)
CONTINUES = Rule(
    "Messages, Rollout",
    "Rollouts of a lane continue each other: obs[0] is the last observation, obs[T], of the rollout before",
    "keep the copies and their last observations between two rollouts of a lane",
)
EPISODES = Rule(
    "Records inside messages, Episode",
    "An episode's return is the undiscounted sum of its raw rewards, and its length the number of its steps, also "
    "where it began in an earlier rollout",
    "add up rewards and steps of valid rows, from an episode's first step to its last",
)
LOG_PROB = Rule(
    "Messages, Rollout",
    "log_prob is that of the action under the policy that acted, computed from the weights of `version`",
    "compare the layers, their order in the flat vector and the activation function with the policy section; sample "
    "from these same probabilities",
)
EVALUATE = Rule(
    "Messages, Evaluate",
    "Evaluate is answered by Evaluated: an episode for each seed, in their order, each cut at `most_steps`",
    "play the episodes on copies of their own, under the weights of the order's version",
)
EVALUATE_ONCE = Rule(
    "Collector profile",
    "An Evaluate is executed once. The last 8 answers are kept, and sent again if the order comes again",
    "keep each Evaluated by its ticket, and send it when that ticket comes again",
)
EVALUATE_VERSION = Rule(
    "Collector profile",
    "An Evaluate is executed under exactly its version: it waits until those weights are held",
    "look for the order's version among the weights held before the first episode",
)
REAPPEARS = Rule(
    "Messages, Hello",
    "`life` is drawn at random for each process, and every attempt has a number of its own",
    "draw `life` at start from a random source, not from the time or the process id",
)
PATIENCE = Rule(
    "The worker's half",
    "The whole check ends within its deadline",
    "look for the step at which the client waits; run this check alone with --only",
)
DECLINED = Rule(
    "The worker's half",
    "A worker that cannot take part in what the Welcome asks for says Goodbye with the reason, and leaves with exit code 2",
    "if the client is not meant to do this, choose the other --profile, or another --env",
)
DRAINING_IGNORES = Rule(
    "The worker's half",
    "While draining, every message but Weights, HeartbeatReply, Rejoin and Refuse is ignored: no new work is taken",
    "look at the state before a message is handled",
)
DRAINING_LEAVES = Rule(
    "The worker's half",
    "Refuse and Rejoin while draining: the worker leaves",
    "end the process when one of them arrives after Drain, and say Hello no more",
)
