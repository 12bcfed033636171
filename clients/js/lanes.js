// The env copies of one session, lane by lane, and what the learner orders of them.
//
// Rule: orders are executed one after another. Each is executed once; its answer is kept until the lane's next order, and sent
// again if the order comes again.
import { actionOf, arrayIn, Frames, put, zeros } from "./arrays.js";

export const now = () => performance.now() / 1000; // in seconds

/** What this process has done since it started, for heartbeats. */
export class Activity {
  began = now(); steps = 0; stepSeconds = 0; calls = 0;
  doing = "starting"; since = now();

  /** Call code of the environment. */
  async call(doing, code) {
    Object.assign(this, { doing, since: now() });
    try {
      return await code();
    } finally {
      Object.assign(this, { doing: "waiting", since: now(), calls: this.calls + 1 });
    }
  }
}

export class Lanes {
  #lanes = new Map(); #unfinished = new Set(); #last = Promise.resolve();

  /** `says`: what is done with answers (`send`), with an error of the environment (`failed`), after the last order (`idle`). */
  constructor(session, run, description, activity, says) {
    Object.assign(this, { session, run, description, activity, says });
  }

  /** The tickets of the orders that are not answered. */
  get tickets() {
    return [...this.#unfinished].map((order) => order.ticket);
  }

  /** Close a lane, if it has this incarnation or an earlier one. */
  close(number, incarnation = Infinity) {
    const lane = this.#lanes.get(number);
    if (!lane || lane.incarnation > incarnation) return;
    this.#lanes.delete(number);
    for (const order of this.#unfinished) if (order.lane === lane) this.#unfinished.delete(order);
    for (const env of lane.envs) env.close?.();
  }

  /** Close all lanes but these. */
  keep(numbers) {
    for (const number of [...this.#lanes.keys()]) if (!numbers.includes(number)) this.close(number);
  }

  /** Take an order: Reset, Step or Call. Throws if it cannot be read. */
  order(type, fields, frames) {
    const [, ticket, number, incarnation] = fields;
    const size = this.run.lanes[number];
    if (![ticket, number, incarnation].every(Number.isSafeInteger) || !size) throw new Error(`${type}: expected a lane of the run`);
    const lane = this.#lanes.get(number);
    const later = lane ? incarnation - lane.incarnation || ticket - lane.ticket : 1;
    if (later < 0) return; // a late copy
    if (later === 0) return lane.answer && this.says.send(lane.answer.head, lane.answer.frames);
    const order = { type, ticket, ...this.#arguments(type, fields, frames, size) };
    if (incarnation !== lane?.incarnation) this.close(number);
    order.lane = this.#lanes.get(number) ?? this.#open(number, incarnation, size);
    Object.assign(order.lane, { ticket, answer: null });
    this.#unfinished.add(order);
    this.#last = this.#last.then(() => this.#execute(order));
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
    try {
      if (!this.#unfinished.has(order)) return; // its lane was closed
      while (lane.envs.length < lane.size) lane.envs.push(await this.activity.call("making", () => this.description.make()));
      if (type === "Reset") for (const [i, n] of order.copies.entries()) await this.#reset(lane, n, order.seeds[i] ?? undefined);
      if (type === "Step") for (let n = 0; n < lane.size; ++n) await this.#step(lane, n, actionOf(this.description.action, order.actions, n));
    } catch (error) {
      if (this.#unfinished.has(order)) this.says.failed(error, lane.number);
      return;
    }
    this.activity.stepSeconds += now() - began;
    if (!this.#unfinished.delete(order)) return;
    this.#answer(order);
    if (!this.#unfinished.size) this.says.idle();
  }

  async #reset(lane, n, seed) {
    const observation = await this.activity.call("resetting", () => lane.envs[n].reset(seed));
    put(this.description.observation, lane.observation, n, observation, "observation of reset");
    lane.reward[n] = lane.terminated[n] = lane.truncated[n] = 0;
  }

  async #step(lane, n, action) {
    if (this.run.autoreset === "NextStep" && (lane.terminated[n] || lane.truncated[n])) return this.#reset(lane, n);
    const { observation, reward, terminated, truncated } = await this.activity.call("stepping", () => lane.envs[n].step(action));
    put(this.description.observation, lane.observation, n, observation, "observation of step");
    if (!Number.isFinite(reward)) throw new Error(`reward: expected a finite number, got ${reward}`);
    lane.reward[n] = reward;
    lane.terminated[n] = terminated ? 1 : 0;
    lane.truncated[n] = truncated ? 1 : 0;
    this.activity.steps += 1;
  }

  #answer({ type, ticket, lane }) {
    const frames = new Frames(), { observation } = this.description, N = [lane.size];
    const begin = [this.session, ticket, lane.number, lane.incarnation];
    const nothing = () => frames.add("|u1", [0], new Uint8Array(0));
    const head = type === "Call"
      ? ["Returned", ...begin, nothing(), "AttributeError: this environment has no attributes for Python", ""]
      : ["Stepped", ...begin, [frames.add(observation.wire, [...N, ...observation.shape], lane.observation)],
        frames.add("<f8", N, lane.reward), frames.add("|b1", N, lane.terminated), frames.add("|b1", N, lane.truncated), nothing()];
    lane.answer = { head, frames: frames.list };
    this.says.send(head, frames.list);
  }
}
