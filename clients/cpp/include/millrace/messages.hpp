// What the learner says: frames -> one Message. Pure, bounded; a Message that is reused allocates nothing after some messages.
//
// Rule: a message is read to its end, and every array checked against its frame, before any of it is used.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <optional>

#include "msgpack.hpp"

namespace millrace {

constexpr std::uint64_t PROTOCOL_VERSION = 16;
constexpr std::size_t MAX_FRAMES = 256, MAX_HEAD_BYTES = 1 << 20, MAX_FRAME_BYTES = 1 << 30, MAX_DIMENSIONS = 8, MAX_COPIES = 1 << 16,
                      MAX_SEATS = 1 << 10, MAX_FACTS = 32;

struct Frame {  // bytes that belong to somebody else
  const void* data;
  std::size_t size;
};

struct Array {  // a view of a received frame
  std::string_view dtype;
  std::array<std::size_t, MAX_DIMENSIONS> shape;
  std::size_t dimensions, elements;
  const void* data;
};

struct Leaf {  // Leaf and ActionSpec of the wire document
  std::string kind, dtype;
  std::vector<std::size_t> shape;
  std::vector<std::int64_t> sizes, start;
  std::uint64_t divisor = 1;
};

struct Run {  // WaitSpec, RunSpec or StepSpec; or what a Describe asks for
  std::string type, env, vector = "loop", autoreset = "NextStep";
  std::string beyond;  // a thing that the learner asks for and this library cannot do; empty if there is none
  double heartbeat_s = 1, learner_timeout_s = 30;
  std::vector<std::size_t> lanes;  // StepSpec: how many copies each lane has
  std::vector<Leaf> observation;
  std::vector<Leaf> action;
  std::size_t rollout_steps = 0, copies = 0;  // of a RunSpec, as is all that follows
  std::vector<std::string> info_keys, seats;
  bool takes_turns = false;
  std::uint64_t seed = 0;
  std::vector<std::size_t> net{64, 64};
  bool relu = false, normalize = false;

  std::size_t columns() const { return copies * std::max<std::size_t>(1, seats.size()); }
};

struct Permit { std::uint64_t ticket, lane, incarnation, sequence; };
struct Received { std::uint64_t lane, incarnation, next_sequence; std::size_t first, count; };  // of `numbers`: out of order
struct LaneIncarnation { std::uint64_t lane, incarnation; };

enum class Type { Welcome, Refuse, Rejoin, Describe, Weights, Collect, Release, Evaluate, HeartbeatReply, Drain, Reset, Step, Call };

struct Message {
  Type type;
  std::optional<std::uint64_t> session;  // Refuse, Weights and Drain have none
  std::uint64_t attempt, ticket, lane, incarnation, version, number, most_steps;
  bool greedy, send_rows;
  std::string text;  // reason of a Refuse or Drain; name of a Call
  std::vector<Permit> permits;
  std::vector<Received> received;
  std::vector<LaneIncarnation> lanes;
  std::vector<std::uint64_t> copies, numbers, keep;
  std::vector<std::optional<std::uint64_t>> seeds;
  std::vector<Array> arrays;  // actions; parameters and buffers
  Run run;
};

inline std::size_t item_bytes(std::string_view dtype) {
  for (const char* known : {"|b1", "|i1", "|u1", "<i2", "<u2", "<i4", "<u4", "<i8", "<u8", "<f2", "<f4", "<f8"})
    if (dtype == known) return static_cast<std::size_t>(known[2] - '0');
  throw BadMessage("array: expected a known dtype");
}

class Decoder {
 public:
  void decode(const std::vector<Frame>& frames, Message& into) {  // throws BadMessage
    if (frames.empty() || frames.size() > MAX_FRAMES) throw BadMessage("message: expected 1 to 256 frames");
    if (frames[0].size > MAX_HEAD_BYTES) throw BadMessage("head: expected at most 1 MB");
    frames_ = &frames;
    used_.assign(frames.size(), 0);
    Message& m = into;
    m.session.reset();
    m.permits.clear(), m.received.clear(), m.lanes.clear(), m.copies.clear();
    m.numbers.clear(), m.keep.clear(), m.seeds.clear(), m.arrays.clear();
    Reader r(frames[0].data, frames[0].size);
    if (r.is_map()) {
      bool refuse = false, reason = false;
      r.fields([&](std::string_view name) {
        if (name == "type") return refuse = r.text() == "Refuse", true;
        if (name == "reason") return m.text = r.text(4000), reason = true;
        return false;
      });
      if (!refuse || !reason) throw BadMessage("head: expected Refuse with its reason");
      m.type = Type::Refuse;
    } else {
      std::size_t fields = r.array();
      if (!fields) throw BadMessage("head: expected a message");
      one(r.text(40), fields - 1, r, m);
    }
    if (!r.done()) throw BadMessage("head: expected nothing after the message");
    for (std::size_t i = 1; i < used_.size(); ++i)
      if (!used_[i]) throw BadMessage("message: expected every frame to be named once");
  }

 private:
  void one(std::string_view name, std::size_t fields, Reader& r, Message& m) {
    auto expect = [&](bool right) { if (!right) throw BadMessage("head: " + std::string(name) + ": expected other fields"); };
    auto session = [&] { m.session = r.natural(); };
    auto order = [&] { session(), m.ticket = r.natural(), m.lane = r.natural(), m.incarnation = r.natural(); };
    if (name == "Welcome") {
      m.type = Type::Welcome, expect(fields == 3), session(), m.attempt = r.natural(), m.run = run(r);
    } else if (name == "Rejoin") {
      m.type = Type::Rejoin, expect(fields == 1), session();
    } else if (name == "Drain") {
      m.type = Type::Drain, expect(fields == 1), m.text = r.text(4000);
    } else if (name == "Weights") {
      m.type = Type::Weights, expect(fields == 3 || fields == 4), m.version = r.natural();
      m.arrays.push_back(array(r)), m.arrays.push_back(array(r));
      if (fields == 4 && !r.nil()) m.arrays.push_back(array(r));
      for (std::size_t i = 0; i < m.arrays.size(); ++i) expect(m.arrays[i].dimensions == 1);
      expect(m.arrays[1].dtype == "<f4");
    } else if (name == "Collect") {
      m.type = Type::Collect, expect(fields == 5), session(), m.version = r.natural();
      for (std::size_t n = r.array(); n; --n) {
        expect(r.array() == 7);
        Permit permit{r.natural(), r.natural(), r.natural(), r.natural()};
        m.permits.push_back(permit), r.natural();  // the round: random numbers are drawn in another way here
        r.skip(), expect(r.nil());  // the opponent: a run with teams is declined; and no past, because Hello asks for none
      }
      received(r, m), keep(r, m);
    } else if (name == "Release") {
      m.type = Type::Release, expect(fields == 2), session();
      for (std::size_t n = r.array(); n; --n) {
        expect(r.array() == 2);
        std::uint64_t lane = r.natural();
        m.lanes.push_back({lane, r.natural()});
      }
    } else if (name == "Evaluate") {
      m.type = Type::Evaluate, expect(fields == 11), session(), m.ticket = r.natural(), m.version = r.natural(), seeds(r, m);
      m.greedy = r.boolean(), m.most_steps = r.natural(), m.send_rows = r.boolean(), m.send_rows |= r.boolean(), r.skip(), r.skip(), keep(r, m);
      expect(m.seeds.size() >= 1 && m.seeds.size() <= 1024 && m.most_steps >= 1);
      for (auto& seed : m.seeds) expect(seed.has_value());
    } else if (name == "HeartbeatReply") {
      m.type = Type::HeartbeatReply, expect(fields == 3), session(), m.number = r.natural(), received(r, m);
    } else if (name == "Describe") {
      m.type = Type::Describe, expect(fields == 5), session(), m.ticket = r.natural();
      m.run = Run{}, env(r, m.run), m.run.vector = r.text(200);
      r.skip();  // the render mode: the description says that this client has none
    } else if (name == "Reset") {
      m.type = Type::Reset, expect(fields == 7), order();
      for (std::size_t n = r.array(); n; --n) m.copies.push_back(r.natural());
      seeds(r, m), m.arrays.push_back(array(r));
      expect(m.copies.size() == m.seeds.size());
    } else if (name == "Step") {
      m.type = Type::Step, expect(fields == 5), order();
      for (std::size_t n = r.array(); n; --n) m.arrays.push_back(array(r));
    } else if (name == "Call") {
      m.type = Type::Call, expect(fields == 8), order();
      for (std::size_t n = r.array(); n; --n) r.natural();
      m.text = r.text(4000), r.boolean(), m.arrays.push_back(array(r));
    } else {
      throw BadMessage("head: expected a message of the learner");
    }
  }

  void keep(Reader& r, Message& m) { for (std::size_t n = r.array(); n; --n) m.keep.push_back(r.natural()); }

  Array array(Reader& r) {
    if (r.array() != 3) throw BadMessage("array: expected [dtype, shape, frame]");
    Array a{r.text(3), {}, 0, 1, nullptr};
    std::size_t size = item_bytes(a.dtype);
    a.dimensions = r.array();
    if (a.dimensions > MAX_DIMENSIONS) throw BadMessage("array: expected at most 8 dimensions");
    for (std::size_t i = 0; i < a.dimensions; ++i) {
      a.shape[i] = r.natural();
      if (a.shape[i] > MAX_FRAME_BYTES || (a.elements *= a.shape[i]) > MAX_FRAME_BYTES) throw BadMessage("array: too large");
    }
    std::size_t frame = r.natural();
    if (frame < 1 || frame >= frames_->size() || used_[frame]) throw BadMessage("array: expected a frame of its own");
    if ((*frames_)[frame].size != a.elements * size) throw BadMessage("array: expected a frame of its shape's size");
    used_[frame] = 1;
    a.data = (*frames_)[frame].data;
    return a;
  }

  static void seeds(Reader& r, Message& m) {
    for (std::size_t n = r.array(); n; --n)
      r.nil() ? m.seeds.emplace_back() : m.seeds.emplace_back(static_cast<std::uint64_t>(r.whole()));
  }

  static void received(Reader& r, Message& m) {
    for (std::size_t n = r.array(); n; --n) {
      std::size_t fields = r.array();
      if (fields < 3 || fields > 4) throw BadMessage("Received: expected 3 or 4 fields");
      Received got{r.natural(), r.natural(), r.natural(), m.numbers.size(), 0};
      for (std::size_t i = fields == 4 ? r.array() : 0; i; --i, ++got.count) m.numbers.push_back(r.natural());
      m.received.push_back(got);
    }
  }

  template <class T> static void list(Reader& r, std::vector<T>& into) {
    into.clear();
    for (std::size_t n = r.array(); n; --n) {
      if constexpr (std::is_same_v<T, std::int64_t>) into.push_back(r.whole());
      else into.push_back(r.natural());
    }
  }

  static void names(Reader& r, std::vector<std::string>& into) {
    into.clear();
    for (std::size_t n = r.array(); n; --n) into.emplace_back(r.text(4000));
  }

  static Leaf leaf(Reader& r) {
    Leaf leaf;
    r.fields([&](std::string_view name) {
      if (name == "kind") leaf.kind = r.text(40);
      else if (name == "dtype") leaf.dtype = r.text(40);
      else if (name == "shape") list(r, leaf.shape);
      else if (name == "sizes") list(r, leaf.sizes);
      else if (name == "start") list(r, leaf.start);
      else if (name == "divisor") leaf.divisor = r.natural();
      else return false;
      return true;
    });
    return leaf;
  }

  static void leaves(Reader& r, std::vector<Leaf>& into) {
    into.clear();
    for (std::size_t n = r.array(); n; --n) into.push_back(leaf(r));
  }

  void env(Reader& r, Run& run) {
    r.fields([&](std::string_view name) {
      if (name == "id") run.env = r.text(1000);
      else if (name == "factory") { if (!r.nil()) array(r), run.beyond = "an environment that is a Python callable"; }
      else if (name == "kwargs" || name == "eval_kwargs") { if (std::size_t n = r.map()) for (run.beyond = "arguments of the environment"; n; --n) r.skip(), r.skip(); }
      else if (name == "wrappers") { if (std::size_t n = r.array()) for (run.beyond = "wrappers written in Python"; n; --n) r.skip(); }
      else return false;
      return true;
    });
  }

  void policy(Reader& r, Run& run) {
    auto must_be_nil = [&](const char* what) { if (!r.nil()) r.skip(), run.beyond = what; };
    r.fields([&](std::string_view name) {
      if (name == "observation") leaves(r, run.observation);
      else if (name == "action") run.action.assign(1, leaf(r));
      else if (name == "net") list(r, run.net);
      else if (name == "activation") run.relu = r.text(40) == "relu";
      else if (name == "normalize_observations") run.normalize = r.boolean();
      else if (name == "head") { if (r.text(40) != "actor_critic") run.beyond = "a policy of this algorithm"; }
      else if (name == "encoder") must_be_nil("an encoder");
      else if (name == "core") must_be_nil("a recurrent core");
      else if (name == "critic") { if (std::size_t n = r.array()) for (run.beyond = "observations that only the critic sees"; n; --n) r.skip(); }
      else if (name == "own") {
        if (r.nil()) return true;
        run.beyond = "a policy written in Python";
        r.fields([&](std::string_view inner) { return inner == "code" && !r.nil() ? (array(r), true) : false; });
      }
      else return false;
      return true;
    });
  }

  Run run(Reader& r) {
    Run run;
    run.learner_timeout_s = -1;
    r.fields([&](std::string_view name) {
      if (name == "type") run.type = r.text(40);
      else if (name == "env") env(r, run);
      else if (name == "envs") for (std::size_t n = r.array(); n; --n) env(r, run);
      else if (name == "policy") policy(r, run);
      else if (name == "teams") { if (std::size_t n = r.array()) for (run.beyond = "opponents that play some of the agents"; n; --n) r.skip(); }
      else if (name == "vector") run.vector = r.text(40);
      else if (name == "autoreset") run.autoreset = r.text(40);
      else if (name == "observation") leaves(r, run.observation);
      else if (name == "action") leaves(r, run.action);
      else if (name == "lanes" && r.is_array()) list(r, run.lanes);
      else if (name == "copies" && !r.is_array()) run.copies = r.natural();
      else if (name == "rollout_steps") run.rollout_steps = r.natural();
      else if (name == "seed") run.seed = r.natural();
      else if (name == "masked") { if (r.boolean()) run.beyond = "action masks"; }
      else if (name == "info_keys") names(r, run.info_keys);
      else if (name == "seats") names(r, run.seats);
      else if (name == "takes_turns") run.takes_turns = r.boolean();
      else if (name == "extras") { if (std::size_t n = r.array()) for (run.beyond = "further arrays"; n; --n) r.skip(); }
      else if (name == "heartbeat_s") run.heartbeat_s = r.real();
      else if (name == "learner_timeout_s") run.learner_timeout_s = r.real();
      else return false;
      return true;
    });
    if (run.learner_timeout_s == -1) run.learner_timeout_s = run.type == "RunSpec" ? 30 : 600;  // its default
    bool collects = run.type == "RunSpec";
    if (!collects && run.type != "StepSpec" && run.type != "WaitSpec") throw BadMessage("Welcome: expected a known run");
    if (collects && (!run.rollout_steps || !run.copies || run.observation.empty() || run.action.empty()))
      throw BadMessage("RunSpec: expected its steps, copies and spaces");
    bool many = run.copies > MAX_COPIES || std::any_of(run.lanes.begin(), run.lanes.end(), [](std::size_t n) { return n > MAX_COPIES; });
    if (many || run.seats.size() > MAX_SEATS) throw BadMessage("Welcome: expected at most 65536 copies in a lane, and 1024 agents in each");
    if (!(run.heartbeat_s > 0) || !(run.learner_timeout_s > 0)) throw BadMessage("Welcome: expected times above 0");
    return run;
  }

  const std::vector<Frame>* frames_ = nullptr;
  std::vector<char> used_;
};

}  // namespace millrace
