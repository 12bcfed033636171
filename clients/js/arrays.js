// Arrays as the wire has them: [dtype, shape, frame] in the head, and the raw bytes in that frame.

const KINDS = {
  "<f4": Float32Array, "<f8": Float64Array, "|u1": Uint8Array, "|b1": Uint8Array, "<i8": BigInt64Array,
};
const WIRE = { float32: "<f4", float64: "<f8", uint8: "|u1", int64: "<i8" };

/** A Box: numbers in [low, high], each one number or one for each element. */
export function box(shape, low, high, dtype = "float32") {
  if (!(dtype in WIRE)) throw new UsageError(`box: expected dtype float32, float64, uint8 or int64, got ${dtype}`);
  return { kind: "box", shape, low, high, dtype, wire: WIRE[dtype], size: shape.reduce((a, b) => a * b, 1) };
}

/** A Discrete space: the integers from `start` to `start + n - 1`. */
export function discrete(n, start = 0) {
  return { kind: "discrete", n, start, shape: [], dtype: "int64", wire: "<i8", size: 1 };
}

/** What the person who started the client has to change. Exit code 2. */
export class UsageError extends Error {}

/** An array for `count` elements of this space. */
export function zeros(space, count) {
  return new KINDS[space.wire](count * space.size);
}

/** Write a value of the space into `array`, as its element `at`. Throws if it does not fit. */
export function put(space, array, at, value, what) {
  const values = typeof value === "number" ? [value] : value;
  if (values?.length !== space.size) throw new Error(`${what}: expected ${space.size} numbers, got ${values?.length ?? typeof value}`);
  for (let i = 0; i < space.size; ++i) {
    const number = Number(values[i]);
    if (!Number.isFinite(number)) throw new Error(`${what}: expected finite numbers, got ${values[i]}`);
    array[at * space.size + i] = array instanceof BigInt64Array ? BigInt(number) : number;
  }
}

/** The action of copy `at`: a number of a Discrete space, else a view of the array. */
export function actionOf(space, array, at) {
  return space.kind === "discrete" ? Number(array[at]) : array.subarray(at * space.size, (at + 1) * space.size);
}

/** The array that [dtype, shape, frame] of the head describes. Throws if the frame does not have its length. */
export function arrayIn([dtype, shape, frame], frames) {
  const Kind = Object.hasOwn(KINDS, dtype) ? KINDS[dtype] : undefined;
  const bytes = frames[frame];
  if (!Kind || !bytes || !Array.isArray(shape)) throw new Error("expected an array of a known dtype, and its frame");
  if (bytes.length !== shape.reduce((a, b) => a * b, Kind.BYTES_PER_ELEMENT)) throw new Error(`frame ${frame}: wrong length`);
  return new Kind(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length)); // a copy, for it must be aligned
}

/** A message with arrays: adds the arrays to the frames, and gives what stands in the head. */
export class Frames {
  list = [];

  add(dtype, shape, array) {
    this.list.push(Buffer.from(array.buffer.slice(array.byteOffset, array.byteOffset + array.byteLength)));
    return [dtype, shape, this.list.length];
  }

  /** A space, as `EnvDescription` has it. */
  space(space) {
    if (space.kind === "discrete") return ["DiscreteSpace", space.n, space.start, "int64"];
    const bounds = [space.low, space.high].map((bound) => {
      const one = typeof bound === "number" || bound.every((each) => each === bound[0]);
      const numbers = typeof bound === "number" ? [bound] : one ? [bound[0]] : bound;
      if (!one && bound.length !== space.size) throw new UsageError(`box: expected ${space.size} bounds, got ${bound.length}`);
      const array = new KINDS[space.wire](Array.from(numbers, space.dtype === "int64" ? BigInt : Number));
      return this.add(space.wire, one ? [] : space.shape, array);
    });
    return ["BoxSpace", space.shape, space.dtype, ...bounds];
  }
}
