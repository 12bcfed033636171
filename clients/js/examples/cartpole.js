// CartPole-v1 with gymnasium's equations, as an environment of Node: node examples/cartpole.js ADDRESS [--name N] [--token FILE]
import { readFileSync } from "node:fs";
import { parseArgs } from "node:util";
import { box, discrete, work } from "../millrace.js";

const GRAVITY = 9.8, CART = 1.0, POLE = 0.1, LENGTH = 0.5, FORCE = 10, TAU = 0.02, LONGEST = 500;
const FARTHEST = 2.4, STEEPEST = (12 * 2 * Math.PI) / 360;

class CartPole {
  #random = generator(Date.now());

  reset(seed) {
    if (seed !== undefined) this.#random = generator(seed);
    this.state = Array.from({ length: 4 }, () => 0.1 * this.#random() - 0.05);
    this.steps = 0;
    return this.state;
  }

  step(action) {
    let [x, speed, angle, turn] = this.state;
    const force = action === 1 ? FORCE : -FORCE, cos = Math.cos(angle), sin = Math.sin(angle);
    const push = (force + POLE * LENGTH * turn ** 2 * sin) / (CART + POLE);
    const turning = (GRAVITY * sin - cos * push) / (LENGTH * (4 / 3 - (POLE * cos ** 2) / (CART + POLE)));
    const pushing = push - (POLE * LENGTH * turning * cos) / (CART + POLE);
    x += TAU * speed;
    speed += TAU * pushing;
    angle += TAU * turn;
    turn += TAU * turning;
    this.state = [x, speed, angle, turn];
    this.steps += 1;
    const terminated = Math.abs(x) > FARTHEST || Math.abs(angle) > STEEPEST;
    return { observation: this.state, reward: 1, terminated, truncated: this.steps >= LONGEST };
  }
}

/** Random numbers in [0, 1): mulberry32. They are not numpy's. */
function generator(seed) {
  let state = Number(BigInt.asUintN(32, BigInt(seed)));
  return () => {
    state = (state + 0x6d2b79f5) | 0;
    let t = Math.imul(state ^ (state >>> 15), 1 | state);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
  };
}

const { positionals, values } = parseArgs({
  allowPositionals: true,
  options: { name: { type: "string", default: `node-${process.pid}` }, token: { type: "string" } },
});
const high = [4.8, 3.4028234663852886e38, 2 * STEEPEST, 3.4028234663852886e38];
process.exitCode = await work(
  { address: positionals[0], name: values.name, token: values.token && readFileSync(values.token, "utf8") },
  {
    id: "CartPole-v1",
    observation: box([4], high.map((each) => -each), high),
    action: discrete(2),
    longestEpisode: LONGEST,
    make: () => new CartPole(),
  },
);
