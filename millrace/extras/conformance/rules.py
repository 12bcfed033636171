"""The rules of the wire document that a client is checked against, and what to do about each that is broken.

Rule: every failure names one of these. The words of each stand in its section of protocol/README.md, which a test holds.
"""

from __future__ import annotations

from dataclasses import dataclass

DOCUMENT = "protocol/README.md"


@dataclass(frozen=True)
class Rule:
    """One rule of the wire document."""

    section: str
    """heading of protocol/README.md; empty for a rule of the check itself"""
    text: str
    """the rule, in the document's words; an ellipsis stands for what is left out between them"""
    mend: str
    """what the author of a client that breaks it does next"""


FRAMES = Rule(
    "Frames",
    "Frame 0, the head, is one msgpack array: the name of the message's type, then its fields in order … All fields "
    "must be present and nothing more … The head must name every frame exactly once, and the frame's length must "
    "match dtype and shape",
    "compare the bytes that the client sends with the table of that message, field by field",
)
LIMITS = Rule(
    "Limits",
    "Every message stays within these limits",
    "cut texts and lists before they are sent, and send arrays in frames of their own",
)
HELLO = Rule(
    "Hello",
    "the worker's name; also its routing id … `process_nonce` + 1 when the process first joins, and one more each time that "
    "it starts to join again",
    "set the DEALER's routing id to the name before connecting; draw `process_nonce` once for each process; send Hello "
    "before all else",
)
ROUTING_ID = Rule(
    "Transport",
    "With keys, a zero byte and a tag follow, which nobody else can compute: BLAKE2b of the name, with a digest of "
    "16 bytes and the 32 raw bytes of the client's secret key as its key, in 32 hexadecimal digits, lower case",
    "make the routing id of the name, a zero byte and the tag; decode the key from the token's base64 first, and "
    "use no other form of it",
)
PROTOCOL = Rule(
    "How it may evolve",
    "Both sides speak exactly one version, `PROTOCOL_VERSION`",
    "write the client for the version that the wire document names, and send that number",
)
HELLO_AGAIN = Rule(
    "Hello",
    "Repeated with backoff until it is answered … A repeated Hello keeps the number",
    "keep a timer while joining, and send the same Hello again when it is due: after 0.25 s, then after twice the "
    "last wait, at most 4 s",
)
WELCOME_ATTEMPT = Rule(
    "The worker's half",
    "It accepts a `Welcome` only if `attempt` is its newest",
    "compare `attempt` of each Welcome with that of the last Hello, and ignore the message when they differ",
)
REPEATED_WELCOME = Rule(
    "The worker's half",
    "In a session, a copy of its `Welcome` changes nothing",
    "compare the session of a Welcome with the current one before anything is closed",
)
REFUSE = Rule(
    "The worker's half",
    "On `Refuse` it leaves in every state … The exit code is 0 after a `Drain` and after a request to stop, 2 after "
    "a `Refuse`, and when it declines what the learner asks for; else 1",
    "show the reason to the user and end the process with exit code 2",
)
AFTER_REFUSE = Rule(
    "The worker's half",
    "After a `Refuse`, and when it joins again, the worker says neither",
    "on Refuse, end the process without Goodbye",
)
DRAIN_JOINING = Rule(
    "The worker's half",
    "while it joins, a worker heeds only `Welcome`, `Refuse` and `Drain`, and leaves on the last two",
    "end the process with exit code 0: the run is over",
)
DRAIN = Rule(
    "The worker's half",
    "On `Drain`, or when it is asked to stop, it takes no new work, finishes a rollout or an order in progress, "
    "sends it, says `Goodbye` with the tickets that it did not finish, and leaves",
    "on Drain, start no new work; after the work in progress send Goodbye, then end the process with exit code 0",
)
STOP = Rule(
    "The worker's half",
    "On `Drain`, or when it is asked to stop, it takes no new work, finishes a rollout or an order in progress, "
    "sends it, says `Goodbye` with the tickets that it did not finish, and leaves",
    "catch SIGTERM, finish the work in progress, send Goodbye, then end the process with exit code 0",
)
AFTER_GOODBYE = Rule(
    "The worker's half",
    "`Goodbye` is the last message of a session, or `Failure` in its place",
    "send Goodbye as the last message",
)
JOINING_IGNORES = Rule(
    "The worker's half",
    "while it joins, a worker heeds only `Welcome`, `Refuse` and `Drain`, and leaves on the last two",
    "look at the state before a message is handled",
)
REJOIN = Rule(
    "The worker's half",
    "`Rejoin` makes it join again, with a later `attempt`",
    "on Rejoin of the current session, add 1 to `attempt` and send Hello at once",
)
OTHER_SESSION = Rule(
    "The worker's half",
    "A worker ignores a message of another session in every state",
    "compare the session of each message with the current one first",
)
SESSION = Rule(
    "Words",
    "also its number, which the learner draws and which stands in `Welcome` and in every later message of the session",
    "take the number from the newest accepted Welcome, and drop unfinished work of the session before",
)
FORGETS = Rule(
    "The worker's half",
    "When a session ends, the worker forgets its env copies, tickets, rollouts and weights",
    "empty all that is kept by lane, ticket and version when a session ends, so that each session begins with "
    "sequence 0; if this check fails also when it runs alone (--only), look for the permit's ticket, lane and "
    "sequence",
)
SILENT = Rule(
    "The heartbeat repairs",
    "`RunSpec.learner_timeout_s` (a worker that heard nothing after a Heartbeat for so long joins again) … Any "
    "message counts as a sign of life",
    "note the time of the first Heartbeat after each message that arrives; `learner_timeout_s` later, join again",
)
IGNORE_UNREADABLE = Rule(
    "The worker's half",
    "A worker ignores a message that it cannot read, such as one with a field more or less than its table, and continues",
    "check the number of fields and frames of each message before it is used; log it, and do not end",
)
STAYS = Rule(
    "The worker's half",
    "It leaves for no other reason, unless it fails: not for what it cannot read, nor because its connection is lost",
    "start the client's command by itself and look at what it prints; it must outlive lost connections, and "
    "messages that it ignores",
)
CONNECTION = Rule(
    "The worker's half",
    "It may lose its connection and make another without leaving the session",
    "let the socket connect again by itself, and keep the state of the session meanwhile",
)
HEARTBEAT = Rule(
    "The worker's half",
    "In a session, it sends a `Heartbeat` every `heartbeat_s`, also while its environment works and while it drains",
    "send heartbeats from a timer, or between env steps, as long as there is a session",
)
HEARTBEAT_REPLIES = Rule(
    "Heartbeat",
    "number of the last HeartbeatReply received; what the learner sent before that has arrived or is lost",
    "keep the largest number of a HeartbeatReply of this session, from 0, and report it",
)
LATE_REPLY = Rule(
    "The worker's half",
    "A reply whose number is not larger than that of the last one is a late copy: it does not list what came after "
    "it, and is ignored",
    "compare the number of a HeartbeatReply with the largest of this session, before its lanes are looked at",
)
HEARTBEAT_TICKETS = Rule(
    "Heartbeat",
    "tickets that are held and not finished: those that wait, and those of the work in progress",
    "list a ticket from its arrival until its work is done, and no other",
)
HEARTBEAT_STEPS = Rule(
    "Heartbeat",
    "env steps since the worker started, in all sessions",
    "count env steps of the process, not of the session",
)
HEARTBEAT_VERSIONS = Rule(
    "Heartbeat",
    "of the weights held, ascending",
    "list the version of every Weights that is held, and drop all weights when a session ends",
)
HEARTBEAT_WAITS = Rule(
    "Heartbeat",
    "true: the worker knows of no run, because its `Welcome` brought a `WaitSpec`, and no second one has come",
    "set `waits` in each Heartbeat from the Welcome that brings a WaitSpec to the one that brings the run, and in no other",
)
DESCRIBE = Rule(
    "Describe",
    "The worker makes one env copy and answers with `Described`, which has the ticket of the order",
    "answer a Describe of this session with Described, and copy its ticket",
)
DESCRIBE_AGAIN = Rule(
    "Describe",
    "An order that comes again is answered by the same description again",
    "answer each Describe that comes, and keep the description, or make it of what does not change",
)
BEGINS = Rule(
    "Describe",
    "the second `Welcome` has the same `session` and `attempt`, and brings the run. The session goes on",
    "when a Welcome of the current session brings a run and none is known, begin it; the number of the last reply stays",
)
ORDER_ANSWERED = Rule(
    "Environment profile",
    "Each `Reset` and `Step` is answered by `Stepped`, each `Call` by `Returned`, with the session, ticket, lane "
    "and incarnation of the order; nothing else is",
    "copy these four numbers from the order into the answer",
)
ORDER_ONLY = Rule(
    "Environment profile",
    "Each `Reset` and `Step` is answered by `Stepped`, each `Call` by `Returned`, with the session, ticket, lane "
    "and incarnation of the order; nothing else is",
    "send Stepped only from the code that executes an order, or that repeats the answer to an order that came again",
)
ORDER_ONCE = Rule(
    "Environment profile",
    "An order that comes again is not executed again: the same answer is sent again",
    "keep the last answer of each lane, and send it again when its ticket comes again",
)
ORDER_OLD = Rule(
    "The worker's half",
    "An order with a smaller ticket than the newest one of its lane is a late copy and is ignored",
    "compare the ticket of an order with the newest of its lane",
)
INCARNATION = Rule(
    "The worker's half",
    "A permit or an order of a higher incarnation starts the lane again: new env copies, sequence 0, nothing is "
    "kept. One of a lower incarnation is ignored",
    "keep the incarnation of each lane, and compare it first",
)
RESET_SOME = Rule(
    "Environment profile",
    "`Reset` starts episodes in the copies that it names … The rows of the other copies in `Stepped` stay what they were",
    "reset only the listed copies, with a seed for each, and answer with the rows of all",
)
OPTIONS = Rule(
    "Reset",
    "the options of `Env.reset`, or None; a list has those of each copy",
    "unpack `options`, and give them to the environment's reset",
)
STEPPED_ARRAYS = Rule(
    "Stepped",
    "one array [N, *leaf] for each leaf of the observation … [N] float64, raw … [N] bool … [bytes] uint8: a list of "
    "pairs of copy and info",
    "send dtypes and shapes as `StepSpec` and the table say; N is the number of copies of the lane",
)
AFTER_RESET = Rule(
    "Environment profile",
    "Their reward is then 0 and their flags false",
    "clear reward, terminated and truncated of each copy that is reset",
)
NEXT_STEP = Rule(
    "Environment profile",
    "With autoreset `NextStep`, a copy whose episode has ended, or that has none, ignores its action and is reset "
    "without a seed: reward 0, both flags false",
    "remember which copies have ended; their next step is a reset",
)
SAME_STEP = Rule(
    "Environment profile",
    "With `SameStep` it is reset in the step that ends the episode: `Stepped` has the first observation of the next "
    "one, and its info the last one of the old as `final_obs`, with `final_info`",
    "after the step that ends an episode, reset the copy at once, without a seed; keep the reward and the flags of "
    "that step",
)
DISABLED = Rule(
    "Environment profile",
    "With `Disabled` it is stepped in any case",
    "leave a copy whose episode has ended as it is, until a Reset names it",
)
OWN_ROW = Rule(
    "Environment profile",
    "Row n of every array is that of copy n",
    "give row n of the actions to copy n, and write what comes of it to row n of every array",
)
TRUNCATED = Rule(
    "What a worker does in a session",
    "An episode has at most `longest_episode` steps: at the last of them `truncated` is set, unless the task itself ended",
    "count the steps of each episode; at the limit set truncated, unless the task itself ended",
)
SEEDED = Rule(
    "Environment profile",
    "The same seed begins the same episode",
    "seed the environment's generator with the given seed",
)
IN_SPACE = Rule(
    "What a worker does in a session",
    "Observations are finite, and within the bounds of the space that it described",
    "describe the space as it is, or mend the environment",
)
RETURNED = Rule(
    "Environment profile",
    "Each `Reset` and `Step` is answered by `Stepped`, each `Call` by `Returned`, with the session, ticket, lane "
    "and incarnation of the order; nothing else is … A worker without attributes answers a `Call` with `error`, and "
    "with no bytes as `results`",
    "answer every Call; a client without attributes answers with `error` set",
)
RELEASE = Rule(
    "The worker's half",
    "The worker closes a lane that a `Release` names, and one that the `received` of a `HeartbeatReply` does not "
    "list: it drops the env copies, tickets and rollouts of the lane, and sends nothing more of them",
    "on Release drop the lane with its orders, tickets and rollouts",
)
UNLISTED = Rule(
    "The worker's half",
    "The worker closes a lane that a `Release` names, and one that the `received` of a `HeartbeatReply` does not "
    "list: it drops the env copies, tickets and rollouts of the lane, and sends nothing more of them",
    "compare the lanes that are held with those of each new HeartbeatReply, and drop the others",
)
LANES = Rule(
    "Words",
    "a ticket as a `Collect` lists it: with the lane, incarnation and sequence of its rollout",
    "take the number of the lane from the order or permit",
)
TICKETS = Rule(
    "Words",
    "permission for one rollout, under one version … a ticket as a `Collect` lists it: with the lane, incarnation "
    "and sequence of its rollout",
    "take ticket and lane of a rollout from its permit",
)
ROLLOUT_ONCE = Rule(
    "The worker's half",
    "A ticket is collected once. The worker keeps the rollout until `received` says that it has arrived. If it is "
    "asked for that ticket again, it sends the same rollout again",
    "keep each rollout until `received` covers its sequence, and send it only once for each Collect that names its ticket",
)
RECEIVED = Rule(
    "The worker's half",
    "A `Collect` of a rollout that was received is ignored",
    "ignore a permit whose sequence is lower than that of its lane's next rollout, unless its rollout is kept",
)
SEQUENCE = Rule(
    "Words",
    "number of the rollout within this lane and incarnation, from 0; lane, incarnation and sequence identify a rollout",
    "take the sequence of a rollout from its permit",
)
IN_ORDER = Rule(
    "The worker's half",
    "The rollouts of a lane are collected in the order of `Permit.sequence`, from 0 in every incarnation. A permit "
    "waits for those before it",
    "keep the sequence of each lane's next rollout, and start only the permit that has it",
)
VERSION = Rule(
    "The worker's half",
    "A rollout is collected under exactly the version that its `Collect` names, also if newer weights have come. It "
    "waits until these weights are held",
    "keep the version with each ticket, keep weights by version, and load those of the ticket before the rollout starts",
)
HOLDS_WEIGHTS = Rule(
    "The worker's half",
    "The worker holds the weights that have come until an order comes. Then it drops those that neither `keep` of this "
    "order lists nor an unfinished ticket names, also as an opponent's, whether of a rollout or of an evaluation",
    "keep weights in a map by version; when a Collect or an Evaluate comes, take its tickets, then drop the weights that "
    "neither its `keep` lists nor a ticket that is left names",
)
ROWS = Rule(
    "Collector profile",
    "The row after the end of an episode only resets that copy … its reward 0, its action any action of the space. "
    "For every copy `valid[t+1]` is not (`terminated[t]` or `truncated[t]`) … All values are finite, integers are "
    "in their space",
    'compare what the section "Collector profile" says of rows with what the client writes, and dtypes and shapes '
    "with the table of Rollout",
)
SEATS = Rule(
    "Collector profile",
    "That row alone is `valid` … no later row of it is valid until the copy is reset … That step has no valid row, and no "
    "other such step follows it",
    'compare what "Seats" says of the rows of an agent with what the client writes, agent by agent',
)
FIRST_RESETS = Rule(
    "Collector profile",
    "`resets[0]` is the `resets[T]` of the rollout before",
    "carry over which copies are to be reset first in the next rollout",
)
OTHER_AGENTS = Rule(
    "Collector profile",
    "A worker declines a run whose `seats` are not those of its environment",
    "compare `seats` of the RunSpec with the agents of the environment, and say Goodbye if they differ",
)
LAST_OBSERVATION = Rule(
    "Collector profile",
    "The row after the end of an episode only resets that copy: its observation is the last one of the old episode, "
    "`obs[t+1]` the first one of the new",
    "do not reset a copy in the step that ends its episode: write the observation of that step, and reset in the next row",
)
INDEPENDENT = Rule(
    "Collector profile",
    "No copy repeats what another one does: its seeds and random numbers are its own, in each lane and incarnation",
    "seed each env copy, and its actions, with numbers of their own, made of the run's seed, the lane, the "
    "incarnation and the copy's number",
)
FIRST_VALID = Rule(
    "Collector profile",
    "the first row of a rollout is not valid if `obs[0]` is the last observation of an episode",
    "carry over which copies ended in the last row of a rollout",
)
CONTINUES = Rule(
    "Collector profile",
    "The rollouts of a lane continue each other: `obs[0]` is `obs[T]` of the one before, and an episode that has "
    "not ended continues",
    "keep the copies and their last observations between two rollouts of a lane",
)
EPISODES = Rule(
    "Episode",
    "the return: undiscounted sum of raw rewards … number of steps",
    "add up rewards and steps of valid rows, from an episode's first step to its last, also where it began in an "
    "earlier rollout",
)
EPISODE_ORDER = Rule(
    "Rollout",
    "the episodes that ended in this rollout, ordered by step, then by copy",
    "go through the steps first, and through the copies in each step",
)
LOG_PROB = Rule(
    "Collector profile",
    "The learner needs `log_prob` to be that of the policy of `version`",
    "compare the layers, their order in the flat vector and the activation function with Parameters and Acting "
    "there; sample from these same probabilities",
)
ROUNDED = Rule(
    "Collector profile",
    "bfloat16 (as uint16: the upper half of a float32) is converted to float32",
    "look at the dtype of `Weights.parameters`: a uint16 is shifted 16 bits up and read as float32",
)
NORMALIZED = Rule(
    "Collector profile",
    "If normalized: (x − mean) / std, clipped to ±10, computed in float64 for float64 and for integers of 32 or 64 bits",
    "read means and standard deviations of all features from `Weights.buffers`, and clip what comes of them",
)
ATTRIBUTES = Rule(
    "Weights",
    "attributes by name, which the copies of a lane get before its next rollout under these weights",
    "set these attributes in every copy of a lane before its first step under these weights, or decline",
)
EVALUATE = Rule(
    "Evaluate",
    "Play one episode for each seed, on copies of their own, under weights of this version. Answered by `Evaluated`",
    "play the episodes on copies of their own, under the weights of the order's version",
)
CUT = Rule(
    "Evaluated",
    "for each episode whether it was cut at `most_steps`; one that ends at this step was not",
    "set `cut` where an episode reaches `most_steps` and neither flag is set",
)
EVALUATE_SEEDS = Rule(
    "Collector profile",
    "The result depends on the order and the weights alone: the same seeds give the same episodes",
    "reset the copies of an evaluation with the seeds of its order, one each, before every evaluation",
)
GREEDY = Rule(
    "Evaluate",
    "true: take the most probable actions; false: draw them",
    "look at `greedy` of each order; the most probable action is that under the weights of its `version`, which may "
    "be others than the newest",
)
EPISODE_ROWS = Rule(
    "EpisodeRows",
    "one array [L+1, *leaf] for each leaf of the observation … [L] float64, raw … also set in the last row of an "
    "episode that was cut",
    "compare dtypes, shapes and flags of EpisodeRows with its table; its reward is float64, that of a Rollout float32",
)
ROWS_FIRST = Rule(
    "Collector profile",
    "`EpisodeRows` come before the `Evaluated` that they belong to; the rows of an episode follow each other without a gap",
    "send all rows of an evaluation, from step 0 of each episode to its end, and then its Evaluated; rows only if "
    "the order asks for them",
)
EVALUATE_ONCE = Rule(
    "Collector profile",
    "The last 8 answers are kept, and sent again if the order comes again",
    "keep each Evaluated by its ticket, and send it when that ticket comes again",
)
EVALUATE_VERSION = Rule(
    "Collector profile",
    "An `Evaluate` is executed once, under exactly its version: it waits until those weights are held",
    "look for the order's version among the weights held before the first episode",
)
EVALUATE_ENDS = Rule(
    "Collector profile",
    "An `Evaluate` of a higher ticket and another version ends the evaluation before it: what is left of that one is "
    "dropped",
    "when an Evaluate comes, drop the orders with lower tickets that name another version",
)
REAPPEARS = Rule(
    "Hello",
    "drawn at random for each process, for pids repeat in containers",
    "draw `process_nonce` at start from a random source, not from the time or the process id",
)
DECLINED = Rule(
    "What a worker does in a session",
    "A worker that cannot do it says `Goodbye` with the reason, and leaves with exit code 2",
    "if the client is not meant to do this, choose the other --profile, or another --env",
)
DRAINING_IGNORES = Rule(
    "The worker's half",
    "While it drains, it sends heartbeats, and heeds only `Weights`, `HeartbeatReply`, `Rejoin` and `Refuse`",
    "look at the state before a message is handled",
)
DRAINING_LEAVES = Rule(
    "The worker's half",
    "`Rejoin` makes it join again, with a later `attempt`; while it drains, it leaves instead. On `Refuse` it "
    "leaves in every state",
    "end the process when one of them arrives after Drain, and say Hello no more",
)
PATIENCE = Rule(
    "",
    "The whole check ends within its deadline",
    "look for the step at which the client waits; run this check alone with --only",
)
