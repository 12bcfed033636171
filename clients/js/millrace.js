// A millrace worker for environments of Node: it resets and steps env copies on order; the policy acts beside the learner.
//
// Rule: this is the worker's half of ../../protocol/README.md, with the states joining, ready, draining and left. What happens
// to the env copies is in lanes.js.
import { randomBytes } from "node:crypto";
import { hostname } from "node:os";
import { decode, encode } from "@msgpack/msgpack";
import { Dealer } from "zeromq";
import { box, discrete, Frames, UsageError } from "./arrays.js";
import { Activity, Lanes, now } from "./lanes.js";
import { readToken, routingId } from "./token.js";

export { box, discrete, UsageError };

const PROTOCOL_VERSION = 16;
const FIELDS = { // how many fields each message of the learner has, of those that the environment profile knows
  Welcome: 3, Rejoin: 1, Describe: 5, Weights: 4, Release: 2, HeartbeatReply: 3, Drain: 1, Reset: 7, Step: 5, Call: 8,
};
const OF_ANY_SESSION = ["Welcome", "Refuse", "Drain", "Weights"];
const OBEYED = { // the table of the wire document: what is not ignored in each state
  joining: ["Welcome", "Refuse", "Drain"],
  ready: ["Refuse", ...Object.keys(FIELDS)],
  draining: ["Refuse", "HeartbeatReply", "Rejoin"],
  left: [],
};
const MAX_FRAME_BYTES = 2 ** 31 - 1;
const FIRST_BACKOFF_S = 0.25, LONGEST_BACKOFF_S = 4, CONNECT_AGAIN_S = 20, TICK_MS = 50;
const line = (text) => String(text).replace(/[\u0000-\u001f\u007f-\u009f\u2028\u2029]/g, " ").slice(0, 1000);

/** Work for a learner until the conversation is over. Returns the exit code: 0 drained, 1 failed or lost the learner, 2 refused. */
export async function work(options, description) {
  try {
    return await new Worker(options, description).run();
  } catch (error) {
    if (!(error instanceof UsageError)) throw error;
    console.error(`${options.name}: ${error.message}`);
    return 2;
  }
}

class Worker {
  #state = "joining";
  #session = 0; #run = null; #lanes = null; #replies = 0;
  #nonce = randomBytes(6).readUIntBE(0, 6); #attempt = this.#nonce; #activity = new Activity();
  #joining = 0; #due = 0; #backoff = 0; #heard = 0; #heardWire = 0; // times in seconds
  #reason = ""; #problem = ""; #unreadable = 0; #sending = Promise.resolve();
  #left; #over = new Promise((resolve) => { this.#left = resolve; });

  /** `address`: tcp://HOST:PORT or ipc://PATH. `name`: of this client alone. `token`: the text of a join token, or nothing. */
  constructor({ address, name, token, joinTimeoutS = 60, rejoinTimeoutS = 600, log = (text) => console.error(text) }, description) {
    if (!name || Buffer.byteLength(name) > 200) throw new UsageError("name: expected 1 to 200 bytes");
    if (token && !address.startsWith("tcp://")) throw new UsageError("token: expected a tcp:// address with it");
    Object.assign(this, { address, name, description, rejoinTimeoutS, joinTimeoutS, token: token ? readToken(token) : null });
    this.log = (text) => log(`${name}: ${text}`);
  }

  async run() {
    this.socket = new Dealer({
      routingId: routingId(this.name, this.token), linger: 2000, handshakeInterval: 2000, connectTimeout: 2000,
      reconnectInterval: 100, reconnectMaxInterval: 2000, sendTimeout: 0, maxMessageSize: MAX_FRAME_BYTES,
      tcpKeepalive: 1, tcpKeepaliveIdle: 15, tcpKeepaliveInterval: 5, tcpKeepaliveCount: 3, tcpMaxRetransmitTimeout: 5000,
      ipv6: this.address.includes("["), ...this.token?.options,
    });
    this.socket.events.on("handshake", () => { this.#problem = ""; });
    this.socket.events.on("handshake:error:auth", ({ error }) => this.#handshakeFailed(error?.status));
    this.socket.events.on("handshake:error:protocol", () => this.#handshakeFailed());
    this.socket.events.on("handshake:error:other", () => this.#handshakeFailed());
    try {
      this.socket.connect(this.address);
    } catch (error) {
      throw new UsageError(`address ${this.address}: expected tcp://HOST:PORT or ipc://PATH; ${error.message}`);
    }
    let stops = 0;
    const stop = () => (stops++ ? this.#leave(0, "it was told to stop") : this.#drain("it was told to stop"));
    process.on("SIGTERM", stop).on("SIGINT", stop);
    this.#join();
    const timer = setInterval(() => this.#tick(), TICK_MS);
    this.#receive();
    const code = await this.#over;
    clearInterval(timer);
    process.off("SIGTERM", stop).off("SIGINT", stop);
    await this.#sending;
    this.socket.close();
    this.log(`left: ${this.#reason}`);
    return code;
  }

  // ---------------------------------------------------------------- the wire

  async #receive() {
    try {
      for await (const frames of this.socket) {
        this.#heardWire = now();
        this.#read(frames);
        if (this.#state === "left") return;
      }
    } catch (error) {
      if (this.#state !== "left") this.#leave(1, `its socket failed: ${error.message}`);
    }
  }

  /** Handle one message of the learner. What cannot be read is ignored. */
  #read(frames) {
    try {
      const head = decode(frames[0]);
      if (!Array.isArray(head)) { // only Refuse is a map
        if (head?.type !== "Refuse" || typeof head.reason !== "string" || Object.keys(head).length !== 2) throw new Error("unknown");
        return this.#handle("Refuse", [head.reason], frames);
      }
      const [type, ...fields] = head;
      const missing = Object.hasOwn(FIELDS, type) ? FIELDS[type] - fields.length : -1;
      if (missing !== 0 && !(missing === 1 && type === "Weights")) throw new Error("unknown type, or other fields than expected");
      this.#handle(type, fields, frames);
    } catch (error) {
      this.#unreadable += 1;
      if (this.#unreadable <= 3) this.log(`the learner sent a message that cannot be used: ${error.message}`);
    }
  }

  #send(head, frames = []) {
    const bytes = encode(head); // now: what it describes may change
    const sent = () => this.socket.send([bytes, ...frames]).catch(() => {}); // what is lost, the conversation repairs
    this.#sending = this.#sending.then(sent);
  }

  #handshakeFailed(status) {
    if (status === 400) this.#leave(2, `the learner at ${this.address} refused this client's key: not allowed there, or revoked`);
    else this.#problem = `${this.address} breaks off the handshake; perhaps it asks for a token, or this token is of another learner`;
  }

  // ---------------------------------------------------------------- the conversation

  #join() {
    this.#state = "joining";
    this.#attempt += 1;
    this.#backoff = FIRST_BACKOFF_S;
    this.#joining = this.#due = this.#heardWire = now();
    this.#tick();
  }

  #tick() {
    const at = now();
    if (this.#state === "joining") {
      if (at - this.#joining > this.joinTimeoutS) return this.#leave(1, `no learner answered at ${this.address}; ${this.#problem}`);
      if (at - this.#heardWire > CONNECT_AGAIN_S) { // the connection may only look open
        this.#heardWire = at;
        this.socket.disconnect(this.address);
        this.socket.connect(this.address);
      }
      if (at < this.#due) return;
      this.#due = at + this.#backoff;
      this.#backoff = Math.min(2 * this.#backoff, LONGEST_BACKOFF_S);
      this.#send({
        type: "Hello", protocol: PROTOCOL_VERSION, worker: this.name, host: line(hostname()), pid: process.pid, process_nonce: this.#nonce,
        software: "millrace JavaScript client", attempt: this.#attempt,
      });
    } else if (this.#state !== "left") {
      if (at - this.#heard > this.#run.learner_timeout_s) this.#rejoin(`the learner was silent for ${this.#run.learner_timeout_s} s`);
      else if (at >= this.#due) this.#heartbeat(at);
    }
  }

  #heartbeat(at) {
    this.#due = at + this.#run.heartbeat_s;
    const { began, steps, stepSeconds, doing, since, calls } = this.#activity;
    const stages = { step: stepSeconds, wait: Math.max(0, at - began - stepSeconds) };
    const held = [this.#replies, [], this.#lanes.tickets];
    const lateActions = 0, note = "", waits = this.#run.type === "WaitSpec";
    this.#send(["Heartbeat", this.#session, ...held, steps, stages, process.memoryUsage.rss(), lateActions, note, waits]);
    this.#send(["Alive", [[this.name, this.#nonce, doing, Math.max(0, at - since), calls]], []]);
  }

  #handle(type, fields, frames) {
    if (!OF_ANY_SESSION.includes(type) && fields[0] !== this.#session) return;
    this.#heard = now();
    if (!OBEYED[this.#state].includes(type)) return;
    switch (type) {
      case "Refuse": return this.#leave(2, line(fields[0]));
      case "Welcome": return this.#welcome(...fields);
      case "Drain": return this.#drain(line(fields[0]));
      case "Rejoin": return this.#rejoin("the learner asks for it");
      case "Release": return fields[1].forEach(([lane, incarnation]) => this.#lanes.close(lane, incarnation));
      case "HeartbeatReply": return this.#replied(...fields.slice(1));
      case "Describe": return this.#describe(...fields.slice(1));
      case "Reset": case "Step": case "Call": if (this.#run.type === "StepSpec") this.#lanes.order(type, fields, frames);
    }
  }

  #welcome(session, attempt, run) {
    if (attempt !== this.#attempt) return;
    const again = this.#state === "ready" && session === this.#session; // the run begins for which this session waits, or a late copy
    if (again && (this.#run.type !== "WaitSpec" || run?.type === "WaitSpec")) return;
    if (!Number.isSafeInteger(session) || typeof run !== "object") throw new Error("Welcome: expected a session and a run");
    this.#lanes?.keep([]);
    this.#state = "ready";
    this.#session = session;
    this.#run = { heartbeat_s: 1, learner_timeout_s: run.type === "RunSpec" ? 30 : 600, autoreset: "NextStep", ...run };
    this.#lanes = new Lanes(session, this.#run, this.description, this.#activity, {
      send: (head, frames) => this.#send(head, frames),
      failed: (error, lane) => this.#failed(error, lane),
      idle: () => this.#state === "draining" && this.#goodbye(0, this.#reason),
    });
    if (!again) this.#replies = 0;
    this.#due = now() + this.#run.heartbeat_s;
    this.joinTimeoutS = this.rejoinTimeoutS;
    const why = this.#unable();
    if (why) return this.#goodbye(2, why);
    if (!again) this.log("joined");
  }

  /** Why this client cannot take part in the run, or nothing. */
  #unable() {
    const run = this.#run;
    if (run.type === "WaitSpec") return;
    if (run.seats?.length) return `this client has no environment of several agents, the learner asks for ${run.seats.join(", ")}`;
    if (run.type === "RunSpec") return "this client does not act: it needs --inference learner, or millrace.make_vec";
    for (const env of run.envs) {
      const why = this.#cannotBe(env);
      if (why) return why;
    }
    if (run.autoreset === "SameStep") return "this client resets a copy in the next step, the learner asks for autoreset SameStep";
  }

  /** Why this client's environment is not the one that the learner asks for, or nothing. */
  #cannotBe(env) {
    if (env.id !== this.description.id) return `this client has the environment ${this.description.id}, the learner asks for ${env.id}`;
    if (env.factory || env.wrappers?.length || Object.keys({ ...env.kwargs, ...env.eval_kwargs }).length)
      return "this client takes no factory, wrappers or arguments of an environment";
  }

  #describe(ticket, env) {
    if (this.#run.type !== "WaitSpec") return;
    const why = this.#cannotBe(env);
    if (why) return this.#goodbye(2, why);
    const frames = new Frames();
    const { observation, action, longestEpisode = 0 } = this.description;
    const spaces = [frames.space(observation), frames.space(action)];
    const metadata = frames.add("|u1", [1], new Uint8Array([0x80])); // an empty dict
    this.#send(["Described", this.#session, ticket, [...spaces, metadata, "", longestEpisode, ""]], frames.list);
  }

  #replied(number, received) {
    if (!(number > this.#replies)) return; // a late copy
    this.#lanes.keep(received.map(([lane]) => lane)); // a Release may have been lost
    this.#replies = number;
  }

  #rejoin(why) {
    if (this.#state === "draining") return this.#leave(1, "the learner does not know this session");
    this.log(`${why}; joining again`);
    this.#lanes.keep([]);
    this.#join();
  }

  #drain(reason) {
    if (this.#state === "joining") return this.#leave(0, reason);
    if (this.#state !== "ready") return;
    this.#state = "draining";
    this.#reason = reason;
    if (!this.#lanes.tickets.length) this.#goodbye(0, reason);
  }

  #goodbye(code, reason) {
    this.#send(["Goodbye", this.#session, line(reason), this.#lanes.tickets]);
    this.#leave(code, reason);
  }

  #failed(error, lane) {
    const text = line(`lane ${lane}: its environment raised: ${error?.message ?? error}`);
    this.#send(["Failure", this.#session, text, String(error?.stack ?? "").slice(0, 64000), lane]);
    this.#leave(1, text);
  }

  #leave(code, reason) {
    if (this.#state === "left") return;
    this.#state = "left";
    this.#reason = reason;
    this.#lanes?.keep([]);
    this.#left(code);
  }
}
