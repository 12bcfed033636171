// Corridor-v0, an environment that exists in this file and in clients/cpp/tests/corridor.cpp only: corridor.js ADDRESS --name N
import { box, discrete, work } from "../millrace.js";

class Corridor {
  reset() {
    this.at = this.steps = 0;
    return [this.at];
  }

  step(action) {
    this.at += action === 1 ? 1 : -1;
    this.steps += 1;
    const terminated = this.at === 5;
    return { observation: [this.at], reward: terminated ? 1 : -0.01, terminated, truncated: this.steps >= 50 };
  }
}

const [address, , name] = process.argv.slice(2);
process.exitCode = await work(
  { address, name },
  { id: "Corridor-v0", observation: box([1], -50, 5), action: discrete(2), longestEpisode: 50, make: () => new Corridor() },
);
