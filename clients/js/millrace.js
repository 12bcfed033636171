// A millrace worker for environments of Node: it resets and steps env copies on order; the policy acts beside the learner.
//
// Rule: this is the worker's half of ../../protocol/README.md, with the states joining, ready, draining and left. An order is
// executed once; its answer is kept until the lane's next order, and sent again if the order comes again.
import { randomBytes } from "node:crypto";
import { hostname } from "node:os";
import { decode, encode } from "@msgpack/msgpack";
import { Dealer } from "zeromq";
import { actionOf, arrayIn, box, discrete, Frames, put, UsageError, zeros } from "./arrays.js";
import { readToken, routingId } from "./token.js";

export { box, discrete, UsageError };

const PROTOCOL_VERSION = 4;
const FIELDS = { // how many fields each message of the learner has
  Welcome: 3, Rejoin: 1, Weights: 4, Collect: 4, Release: 2, Evaluate: 8, HeartbeatReply: 3, Drain: 1, Reset: 7, Step: 5, Call: 8,
};
const MAX_FRAME_BYTES = 2 ** 31 - 1;
const FIRST_BACKOFF_S = 0.25, LONGEST_BACKOFF_S = 4, CONNECT_AGAIN_S = 20, TICK_MS = 50;
const now = () => performance.now() / 1000;
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

export class Worker {
  #state = "joining";
  #session = 0; #run = null; #replies = 0;
  #lanes = new Map(); #orders = Promise.resolve(); #unfinished = new Set();
  #life = randomBytes(6).readUIntBE(0, 6); #attempt = this.#life;
  #steps = 0; #stepSeconds = 0; #calls = 0; #doing = "starting"; #since = now();
  #reason = ""; #problem = ""; #sending = Promise.resolve();
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
        this.heardWire = now();
        this.read(frames);
        if (this.#state === "left") return;
      }
    } catch (error) {
      if (this.#state !== "left") this.#leave(1, `its socket failed: ${error.message}`);
    }
  }

  /** Handle one message of the learner. What cannot be read is ignored. */
  read(frames) {
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
      this.unreadable = (this.unreadable ?? 0) + 1;
      if (this.unreadable <= 3) this.log(`the learner sent a message that cannot be used: ${error.message}`);
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
    this.backoff = FIRST_BACKOFF_S;
    this.joining = this.due = this.heardWire = now();
    this.#tick();
  }

  #tick() {
    const at = now();
    if (this.#state === "joining") {
      if (at - this.joining > this.joinTimeoutS) return this.#leave(1, `no learner answered at ${this.address}; ${this.#problem}`);
      if (at - this.heardWire > CONNECT_AGAIN_S) { // the connection may only look open
        this.heardWire = at;
        this.socket.disconnect(this.address);
        this.socket.connect(this.address);
      }
      if (at < this.due) return;
      this.due = at + this.backoff;
      this.backoff = Math.min(2 * this.backoff, LONGEST_BACKOFF_S);
      this.#send({
        type: "Hello", protocol: PROTOCOL_VERSION, worker: this.name, host: line(hostname()), pid: process.pid, life: this.#life,
        software: "millrace JavaScript client", attempt: this.#attempt,
      });
    } else if (this.#state !== "left") {
      if (at - this.heard > this.#run.learner_timeout_s) this.#rejoin(`the learner was silent for ${this.#run.learner_timeout_s} s`);
      else if (at >= this.due) this.#heartbeat(at);
    }
  }

  #heartbeat(at) {
    this.due = at + this.#run.heartbeat_s;
    const stages = { step: this.#stepSeconds, wait: Math.max(0, at - this.began - this.#stepSeconds) };
    const held = [...this.#unfinished].map((order) => order.ticket);
    this.#send(["Heartbeat", this.#session, this.#replies, -1, held, this.#steps, stages, process.memoryUsage.rss()]);
    if (this.#run.type === "DescribeSpec") return this.#describe(); // it may have been lost
    this.#send(["Alive", [[this.name, this.#life, this.#doing, Math.max(0, at - this.#since), this.#calls]], []]);
  }

  #handle(type, fields, frames) {
    const state = this.#state;
    if (state === "left") return;
    if (type === "Refuse") return this.#leave(2, line(fields[0]));
    if (type === "Welcome") return state === "draining" ? undefined : this.#welcome(...fields);
    if (type === "Drain") {
      this.heard = now();
      return state === "draining" ? undefined : this.#drain(line(fields[0]));
    }
    if (state === "joining" || (type !== "Weights" && fields[0] !== this.#session)) return;
    if (state === "draining" && !["Weights", "HeartbeatReply", "Rejoin"].includes(type)) return;
    if (type === "Rejoin")
      return state === "draining" ? this.#leave(1, "the learner does not know this session") : this.#rejoin("the learner asks for it");
    this.heard = now();
    if (type === "Release") for (const [lane, incarnation] of fields[1]) this.#close(lane, incarnation);
    else if (type === "HeartbeatReply") this.#replied(...fields.slice(1));
    else if (["Reset", "Step", "Call"].includes(type) && this.#run.type === "StepSpec") this.#order(type, fields, frames);
  }

  #welcome(session, attempt, run) {
    if (attempt !== this.#attempt || (this.#state === "ready" && session === this.#session)) return;
    if (!Number.isSafeInteger(session) || typeof run !== "object") throw new Error("Welcome: expected a session and a run");
    this.#end();
    this.#state = "ready";
    this.#session = session;
    this.#run = { heartbeat_s: 1, learner_timeout_s: run.type === "StepSpec" ? 600 : 30, autoreset: "NextStep", ...run };
    this.#replies = this.#stepSeconds = 0;
    this.heard = this.began = now();
    this.due = this.heard + this.#run.heartbeat_s;
    this.joinTimeoutS = this.rejoinTimeoutS;
    const why = this.#unable();
    if (why) {
      this.#goodbye(why);
      return this.#leave(2, why);
    }
    this.log("joined");
    if (run.type === "DescribeSpec") this.#describe();
  }

  /** Why this client cannot take part in the run, or nothing. */
  #unable() {
    const run = this.#run;
    if (run.type === "RunSpec") return "this client steps copies on order; start the learner with --inference learner";
    for (const env of run.type === "StepSpec" ? run.envs : [run.env]) {
      if (env.id !== this.description.id) return `this client has the environment ${this.description.id}, the learner asks for ${env.id}`;
      if (env.factory || env.wrappers?.length || Object.keys(env.kwargs ?? {}).length)
        return "this client takes no factory, wrappers or arguments of an environment";
    }
    if (run.type === "StepSpec" && run.autoreset !== "NextStep")
      return `this client resets a copy in the next step, the learner asks for autoreset ${run.autoreset}`;
  }

  #describe() {
    const frames = new Frames();
    const { observation, action, longestEpisode = 0 } = this.description;
    const spaces = [frames.space(observation), frames.space(action)];
    const metadata = frames.add("|u1", [1], new Uint8Array([0x80])); // an empty dict
    this.#send(["Described", this.#session, [...spaces, metadata, "", longestEpisode, ""]], frames.list);
  }

  #replied(number, received) {
    if (!(number > this.#replies)) return; // a late copy
    const lanes = new Set(received.map(([lane]) => lane));
    this.#replies = number;
    for (const lane of [...this.#lanes.keys()]) if (!lanes.has(lane)) this.#close(lane, Infinity); // its Release was lost
  }

  #rejoin(why) {
    this.log(`${why}; joining again`);
    this.#end();
    this.#join();
  }

  #drain(reason) {
    if (this.#state === "joining") return this.#leave(0, reason);
    if (this.#state !== "ready") return;
    this.#state = "draining";
    this.#reason = reason;
    if (!this.#unfinished.size) this.#drained();
  }

  #drained() {
    this.#goodbye(this.#reason);
    this.#leave(0, this.#reason);
  }

  #goodbye(reason) {
    this.#send(["Goodbye", this.#session, line(reason), [...this.#unfinished].map((order) => order.ticket)]);
  }

  #leave(code, reason) {
    if (this.#state === "left") return;
    this.#state = "left";
    this.#reason = reason;
    this.#end();
    this.#left(code);
  }

  // ---------------------------------------------------------------- lanes and orders

  /** A session ended: forget its env copies and orders. */
  #end() {
    for (const lane of [...this.#lanes.keys()]) this.#close(lane, Infinity);
    this.#unfinished.clear();
  }

  #close(number, incarnation) {
    const lane = this.#lanes.get(number);
    if (!lane || lane.incarnation > incarnation) return;
    this.#lanes.delete(number);
    for (const order of this.#unfinished) if (order.lane === lane) this.#unfinished.delete(order);
    for (const env of lane.envs) env.close?.();
  }

  #order(type, fields, frames) {
    const [, ticket, number, incarnation] = fields;
    const size = this.#run.lanes[number];
    if (![ticket, number, incarnation].every(Number.isSafeInteger) || !size) throw new Error(`${type}: expected a lane of the run`);
    let lane = this.#lanes.get(number);
    if (lane && (incarnation < lane.incarnation || (incarnation === lane.incarnation && ticket < lane.ticket))) return;
    if (lane && incarnation === lane.incarnation && ticket === lane.ticket)
      return lane.answer ? this.#send(lane.answer.head, lane.answer.frames) : undefined;
    const arguments_ = this.#arguments(type, fields, frames, size);
    if (lane && incarnation > lane.incarnation) {
      this.#close(number, incarnation);
      lane = undefined;
    }
    lane ??= this.#open(number, incarnation, size);
    Object.assign(lane, { ticket, answer: null });
    const order = { type, ticket, lane, ...arguments_ };
    this.#unfinished.add(order);
    this.#orders = this.#orders.then(() => this.#execute(order));
  }

  /** The checked arguments of an order. */
  #arguments(type, fields, frames, size) {
    if (type === "Reset") {
      const [copies, seeds] = [fields[4], fields[5]];
      const natural = (number) => Number.isInteger(number) && number >= 0;
      if (copies.length !== seeds.length || !copies.every((copy) => natural(copy) && copy < size)
          || !seeds.every((seed) => seed === null || natural(seed)))
        throw new Error("Reset: expected copies of the lane, and a seed for each");
      return { copies, seeds };
    }
    if (type === "Call") return {};
    if (fields[4].length !== 1 || frames.length !== 2) throw new Error("Step: expected one array of actions");
    const { action } = this.description;
    const actions = arrayIn(fields[4][0], frames);
    if (fields[4][0][0] !== action.wire || actions.length !== size * action.size) throw new Error("Step: expected one action for each copy");
    return { actions };
  }

  #open(number, incarnation, size) {
    const lane = {
      number, incarnation, size, envs: [], observation: zeros(this.description.observation, size), reward: new Float64Array(size),
      terminated: new Uint8Array(size), truncated: new Uint8Array(size).fill(1), // a step resets the copies, unless a Reset did
    };
    this.#lanes.set(number, lane);
    return lane;
  }

  async #execute(order) {
    const { lane, type } = order, began = now();
    if (!this.#unfinished.has(order)) return; // its session or lane ended
    try {
      if (!lane.envs.length) for (let n = 0; n < lane.size; ++n) lane.envs.push(await this.#call("making", () => this.description.make()));
      if (type === "Reset") for (const [i, n] of order.copies.entries()) await this.#reset(lane, n, order.seeds[i] ?? undefined);
      else if (type === "Step") for (let n = 0; n < lane.size; ++n) await this.#step(lane, n, actionOf(this.description.action, order.actions, n));
    } catch (error) {
      if (!this.#unfinished.has(order)) return;
      const text = line(`lane ${lane.number}: its environment raised: ${error?.message ?? error}`);
      this.#send(["Failure", this.#session, text, String(error?.stack ?? "").slice(0, 64000), lane.number]);
      return this.#leave(1, text);
    }
    this.#stepSeconds += now() - began;
    if (!this.#unfinished.delete(order)) return;
    this.#answer(order);
    if (this.#state === "draining" && !this.#unfinished.size) this.#drained();
  }

  async #call(doing, code) {
    this.#doing = doing;
    this.#since = now();
    try {
      return await code();
    } finally {
      this.#doing = "waiting";
      this.#since = now();
      this.#calls += 1;
    }
  }

  async #reset(lane, n, seed) {
    const observation = await this.#call("resetting", () => lane.envs[n].reset(seed));
    put(this.description.observation, lane.observation, n, observation, "observation of reset");
    lane.reward[n] = lane.terminated[n] = lane.truncated[n] = 0;
  }

  async #step(lane, n, action) {
    if (lane.terminated[n] || lane.truncated[n]) return this.#reset(lane, n);
    const { observation, reward, terminated, truncated } = await this.#call("stepping", () => lane.envs[n].step(action));
    put(this.description.observation, lane.observation, n, observation, "observation of step");
    if (!Number.isFinite(reward)) throw new Error(`reward: expected a finite number, got ${reward}`);
    lane.reward[n] = reward;
    lane.terminated[n] = terminated ? 1 : 0;
    lane.truncated[n] = truncated ? 1 : 0;
    this.#steps += 1;
  }

  #answer({ type, ticket, lane }) {
    const frames = new Frames(), { observation } = this.description, N = [lane.size];
    const begin = [this.#session, ticket, lane.number, lane.incarnation];
    const nothing = () => frames.add("|u1", [0], new Uint8Array(0));
    const head = type === "Call"
      ? ["Returned", ...begin, nothing(), "AttributeError: this environment has no attributes for Python", ""]
      : ["Stepped", ...begin, [frames.add(observation.wire, [...N, ...observation.shape], lane.observation)],
        frames.add("<f8", N, lane.reward), frames.add("|b1", N, lane.terminated), frames.add("|b1", N, lane.truncated), nothing()];
    lane.answer = { head, frames: frames.list };
    this.#send(head, frames.list);
  }
}
