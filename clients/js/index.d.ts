/** A millrace worker for environments of Node. See README.md. */

export interface BoxSpace {
  readonly kind: "box";
  readonly shape: readonly number[];
  readonly dtype: "float32" | "float64" | "uint8" | "int64";
}
export interface DiscreteSpace {
  readonly kind: "discrete";
  readonly n: number;
  readonly start: number;
}
export type Space = BoxSpace | DiscreteSpace;

/** A Box: numbers in [low, high], each one number or one for each element. */
export function box(
  shape: readonly number[],
  low: number | readonly number[],
  high: number | readonly number[],
  dtype?: BoxSpace["dtype"],
): BoxSpace;
/** A Discrete space: the integers from `start` to `start + n - 1`. */
export function discrete(n: number, start?: number): DiscreteSpace;

/** A number of a Discrete space, or the elements of a Box. */
export type Observation = number | ArrayLike<number>;
export type Action = number | Float32Array | Float64Array | Uint8Array | BigInt64Array;

export interface StepResult {
  observation: Observation;
  reward: number;
  /** The task ended: do not bootstrap. */
  terminated: boolean;
  /** A time limit cut the episode off. */
  truncated: boolean;
}

/** One env copy. Its methods may be asynchronous; then heartbeats are sent while they run. */
export interface Env {
  /** Begin an episode; without a seed, go on with the same random numbers. */
  reset(seed?: number): Observation | Promise<Observation>;
  step(action: any): StepResult | Promise<StepResult>;
  close?(): void;
}

export interface Description {
  /** The environment's name; `millrace learner` must be given the same. */
  id: string;
  observation: Space;
  action: Space;
  /** Time limit in steps; 0 or nothing: none. */
  longestEpisode?: number;
  make(): Env | Promise<Env>;
}

export interface Options {
  /** tcp://HOST:PORT or ipc://PATH */
  address: string;
  /** Each client needs a name of its own. */
  name: string;
  /** The text of a join token (`millrace keys new NAME`). */
  token?: string;
  /** Seconds to wait for a learner at first, and after a session. */
  joinTimeoutS?: number;
  rejoinTimeoutS?: number;
  log?(text: string): void;
}

/** What the person who started the client has to change. */
export class UsageError extends Error {}

/** Work for a learner until the conversation is over. Returns the exit code: 0 drained, 1 failed or lost the learner, 2 refused. */
export function work(options: Options, description: Description): Promise<number>;
