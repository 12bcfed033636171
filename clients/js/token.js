// Join tokens: whom to trust, and who we are (CURVE keys). `millrace keys new NAME` makes them.
import { createHash, createPrivateKey, createPublicKey } from "node:crypto";
import { blake2b } from "@noble/hashes/blake2.js";
import { UsageError } from "./arrays.js";

const PREFIX = "millrace1.";
const X25519 = Buffer.from("302e020100300506032b656e04220420", "hex"); // PKCS #8, before the 32 bytes of the secret key
const Z85 = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#";

/** The keys of a token, as socket options of `zeromq`, and its secret. Throws `UsageError` with what is wrong. */
export function readToken(text) {
  const token = text.trim();
  if (!token.startsWith(PREFIX)) throw new UsageError(`token: expected one line that begins with ${PREFIX}, got something else`);
  const body = Buffer.from(token.slice(PREFIX.length), "base64url");
  if (body.length !== 68) throw new UsageError(`token: expected 101 characters, got ${token.length}; copy it again`);
  const hash = createHash("sha256").update(PREFIX).update(body.subarray(0, 64)).digest();
  if (!hash.subarray(0, 4).equals(body.subarray(64))) throw new UsageError("token: a character of it is wrong; copy it again");
  const secret = body.subarray(32, 64);
  const key = createPrivateKey({ key: Buffer.concat([X25519, secret]), format: "der", type: "pkcs8" });
  const publicKey = createPublicKey(key).export({ format: "der", type: "spki" }).subarray(-32);
  return {
    secret,
    options: { curveServerKey: z85(body.subarray(0, 32)), curvePublicKey: z85(publicKey), curveSecretKey: z85(secret) },
  };
}

/** The routing id: the name, and with a token a tag that nobody else can compute. */
export function routingId(name, token) {
  if (!token) return name;
  const tag = blake2b(Buffer.from(name), { key: new Uint8Array(token.secret), dkLen: 16 });
  return `${name}\0${Buffer.from(tag).toString("hex")}`;
}

function z85(bytes) {
  let text = "";
  for (let at = 0; at < bytes.length; at += 4)
    for (let n = bytes.readUInt32BE(at), power = 85 ** 4; power >= 1; power /= 85) text += Z85[Math.floor(n / power) % 85];
  return text;
}
