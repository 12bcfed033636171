// A client's half of the conversation, from its first Hello until it leaves: join, heartbeat, drain, rejoin.
//
// Rule: the learner hears from us at least every `heartbeat_s`, also while the environment's code runs: then a second
// thread sends the heartbeats. One mutex guards all; the first thread gives it up only while it runs the environment.
#pragma once
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <csignal>
#include <cstdio>
#include <fstream>
#include <limits>
#include <map>
#include <memory>
#include <mutex>
#include <random>
#include <thread>

#include "link.hpp"

namespace millrace {

struct Space {  // one array: a Box of float32, float64, uint8 or int64, or a Discrete
  std::string kind, dtype;
  std::vector<std::size_t> shape;
  std::vector<double> low, high;  // of a Box: one number for each element, or one for all
  std::int64_t n = 0, start = 0;  // of a Discrete

  static Space box(std::vector<std::size_t> shape, std::vector<double> low, std::vector<double> high, std::string dtype = "float32") {
    Space made{"box", std::move(dtype), std::move(shape), std::move(low), std::move(high), 0, 0};
    for (const std::vector<double>* bound : {&made.low, &made.high})
      if (bound->size() != 1 && bound->size() != made.elements()) throw UsageError("space: expected a bound for each element, or one");
    return made;
  }
  static Space discrete(std::int64_t n, std::int64_t start = 0) { return {"discrete", "int64", {}, {}, {}, n, start}; }
  const char* wire() const {  // the dtype as the wire writes it
    return dtype == "float32" ? "<f4" : dtype == "float64" ? "<f8" : dtype == "uint8" ? "|u1" : dtype == "int64" ? "<i8"
           : throw UsageError("space: expected dtype float32, float64, uint8 or int64, got " + dtype);
  }
  std::size_t elements() const {
    std::size_t all = 1;
    for (std::size_t side : shape) all *= side;
    return all;
  }
  std::size_t bytes() const { return elements() * item_bytes(wire()); }
  void append(double value, std::vector<unsigned char>& bytes) const {  // in the dtype
    auto as = [&](auto number) { bytes.insert(bytes.end(), reinterpret_cast<unsigned char*>(&number), reinterpret_cast<unsigned char*>(&number + 1)); };
    if (dtype == "float32") as(static_cast<float>(value));
    else if (dtype == "float64") as(value);
    else if (dtype == "uint8") as(static_cast<std::uint8_t>(value));
    else as(static_cast<std::int64_t>(value));
  }
  std::vector<unsigned char> any() const {  // a value of the space, always the same
    std::vector<unsigned char> value;
    if (kind == "discrete") append(static_cast<double>(start), value);
    else for (std::size_t i = 0; i < elements(); ++i) append(std::clamp(0.0, low[i % low.size()], high[i % high.size()]), value);
    return value;
  }
  std::uint64_t divisor() const {  // a policy sees each value divided by it: bytes whose bounds are 0 and 255
    auto all = [](const std::vector<double>& bounds, double bound) { return std::all_of(bounds.begin(), bounds.end(), [=](double each) { return each == bound; }); };
    return kind == "box" && dtype == "uint8" && all(low, 0) && all(high, 255) ? 255 : 1;
  }
  bool is(const Leaf& leaf) const {
    return leaf.kind == kind && leaf.shape == shape && leaf.dtype == dtype && leaf.divisor == divisor() &&
           (kind == "box" || (leaf.sizes == std::vector{n} && leaf.start == std::vector{start}));
  }
};

struct Description {  // the environment, for a learner that does not know it
  std::string id;
  Space observation, action;
  std::uint64_t longest_episode = 0;  // time limit in steps; 0: none
  std::vector<std::string> seats{};   // the names of its agents, if it has several; the spaces are those of each
  bool takes_turns = false;           // whether an agent may have to wait for others between two of its actions
};

struct Options {
  std::string address, name, token;  // token: its text, or empty
  double join_timeout_s = 60, rejoin_timeout_s = 600;
};

inline volatile std::sig_atomic_t stop_requests = 0;
inline void drain_on_signals() {  // SIGTERM or SIGINT: finish the work in progress, then leave; twice: leave at once
  auto handler = [](int) { stop_requests = stop_requests + 1; };
  std::signal(SIGTERM, handler), std::signal(SIGINT, handler);
}
inline double now_s() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

class Session {
 public:
  Session(Options options, Description description)
      : description_(std::move(description)), options_(std::move(options)), token_(token_of(options_)),
        link_(options_.address, options_.name, token_), join_timeout_s_(options_.join_timeout_s) {
    std::random_device random;
    process_nonce_ = attempt_ = (std::uint64_t(random()) << 32 | random()) >> 16;
    gethostname(host_, sizeof host_ - 1);
    begin_to_join();
    beat_ = std::thread([this] { beat(); });
  }
  virtual ~Session() { close(); }
  int exit_code() const { return exit_code_; }  // 0: drained, 1: failed or lost the learner, 2: refused
  const std::string& reason() const { return reason_; }

 protected:
  enum class State { joining, ready, draining, left };

  virtual std::string begin(const Run& run) = 0;      // a session begins; returns why we cannot take part, or nothing
  virtual void end() = 0;                             // a session ended: forget env copies, tickets, rollouts, weights
  virtual void handle(const Message& message) = 0;    // orders, tickets, weights of this session
  virtual void release(std::uint64_t lane, std::uint64_t incarnation) = 0;  // another worker has it from this incarnation on
  virtual std::vector<std::uint64_t> lanes() const = 0;
  virtual const std::vector<std::uint64_t>& tickets() = 0;   // held and not finished
  virtual const std::vector<std::uint64_t>& versions() = 0;  // of the weights held, ascending
  virtual bool busy() const { return false; }         // work in progress, which draining finishes

  void close() {  // the last class calls it in its destructor, because the second thread calls the functions above
    if (!beat_.joinable()) return;
    {
      std::lock_guard guard(mutex_);
      closing_ = true;
      if (state_ == State::ready || state_ == State::draining) goodbye("its program ended"), leave(0, "the program ended");
    }
    wake_.notify_all();
    beat_.join();
  }
  void now_doing(const char* doing) { doing_ = doing, since_s_ = now_s(), ++env_calls_; }
  void pump(double wait_s) {  // do what is due, then handle all that arrives within `wait_s`
    for (; stops_ < stop_requests && state_ != State::left; ++stops_) drain("it was told to stop", true);
    tick(now_s());
    bool arrived = link_.wait(state_ == State::left ? 0 : std::min({0.5, wait_s, std::max(0.0, due_s_ - now_s())}));
    if (link_.refused && state_ != State::left) leave(2, link_.problem);
    while (arrived && state_ != State::left) {
      const std::vector<Frame>* frames = link_.receive();
      if (!frames) break;
      heard_wire_s_ = now_s();
      try {
        decoder_.decode(*frames, message_);
        receive(message_);
      } catch (const BadMessage& error) {
        if (++unreadable_ <= 3) log("the learner sent a message that cannot be used: " + std::string(error.what()));
      }
    }
  }
  void drained() {  // the work in progress has ended
    if (state_ != State::draining) return;
    goodbye(reason_);
    leave(0, reason_);
  }
  void decline(const std::string& why) { goodbye(why), leave(2, why); }
  void fail(const std::string& error, std::optional<std::uint64_t> lane) {  // the environment raised
    Writer& w = head_.begin("Failure", 5).natural(session_).text(line(error)).text("");
    (lane ? w.natural(*lane) : w.nil()).boolean(false);
    link_.send(head_);
    leave(1, error);
  }
  virtual void log(const std::string& text) const {  // override it to use your program's log
    std::fprintf(stderr, "%s: %s\n", options_.name.c_str(), text.c_str());
  }

  void receive(const Message& m) {
    const bool draining = state_ == State::draining;
    switch (m.type) {  // the table of the wire document
      case Type::Refuse: return leave(2, m.text);
      case Type::Welcome: return draining ? void() : welcome(m);
      case Type::Drain: return heard_s_ = now_s(), draining ? void() : drain(m.text, false);
      default: break;
    }
    if (state_ == State::joining || (m.session && *m.session != session_)) return;  // of an earlier session
    heard_s_ = now_s();
    switch (m.type) {
      case Type::Rejoin: return draining ? leave(1, "the learner does not know this session") : rejoin("the learner asks for it");
      case Type::Weights: return handle(m);
      case Type::HeartbeatReply: return replied(m);
      case Type::Describe: return draining || run_.type != "WaitSpec" ? void() : describe(m);
      default: if (draining) return;
    }
    if (m.type != Type::Release) return handle(m);
    for (const LaneIncarnation& lane : m.lanes) release(lane.lane, lane.incarnation);
  }

  class InEnv {  // while it exists, environment code runs and the other thread sends the heartbeats
   public:
    InEnv(Session& session, const char* doing) : session_(session) { session.now_doing(doing), session.mutex_.unlock(); }
    ~InEnv() { session_.mutex_.lock(), session_.now_doing("waiting"); }

   private:
    Session& session_;
  };

  static std::string line(const std::string& text) {  // as the wire wants a text. ASCII: no cut is within a character
    std::string one = text.substr(0, 1000);
    for (char& c : one) if (c < ' ' || c > '~') c = '?';
    return one;
  }
  std::uint64_t attempt() const { return attempt_; }
  State state_ = State::joining;
  Description description_;
  Run run_;
  std::uint64_t session_ = 0, steps_ = 0, late_actions_ = 0;
  double act_s_ = 0, step_s_ = 0, evaluate_s_ = 0;
  Writer head_;
  std::mutex mutex_;
  Options options_;
  void send(const Writer& head, const Frame* arrays, std::size_t count) { link_.send(head, arrays, count); }
  void send(const Writer& head, std::initializer_list<Frame> arrays = {}) { send(head, arrays.begin(), arrays.size()); }

 private:
  static std::optional<Token> token_of(const Options& options) {
    if (options.token.empty()) return std::nullopt;
    if (options.address.compare(0, 6, "tcp://") != 0) throw UsageError("token: expected a tcp:// address with it");
    return Token::read(options.token);
  }
  void begin_to_join() {
    ++attempt_;
    state_ = State::joining;
    joining_s_ = due_s_ = heard_wire_s_ = now_s();
    backoff_s_ = 0.25;
  }

  void tick(double now) {
    if (state_ == State::left) return;
    if (state_ == State::joining) {
      if (now - joining_s_ > join_timeout_s_)
        return leave(1, "no learner answered at " + options_.address + (link_.problem.empty() ? "" : "; " + link_.problem));
      if (now - heard_wire_s_ > 20) heard_wire_s_ = now, link_.connect_again();  // it may only look open
      if (now >= due_s_) due_s_ = now + backoff_s_, backoff_s_ = std::min(2 * backoff_s_, 4.0), hello();
    } else if (now - heard_s_ > run_.learner_timeout_s) {
      rejoin("the learner was silent for " + std::to_string(int(run_.learner_timeout_s)) + " s");
    } else {
      heartbeat_if_due(now);
    }
  }

  void hello() {
    head_.bytes.clear();
    head_.map(8).text("type").text("Hello").text("protocol").natural(PROTOCOL_VERSION).text("worker").text(options_.name)
        .text("host").text(host_).text("pid").natural(static_cast<std::uint64_t>(getpid())).text("process_nonce").natural(process_nonce_)
        .text("software").text("millrace C++ client").text("attempt").natural(attempt_);
    link_.send(head_);
  }

  void heartbeat_if_due(double now) {
    if (now < due_s_) return;
    due_s_ = now + run_.heartbeat_s;
    Writer& w = beat_head_.begin("Heartbeat", 10).natural(session_).natural(replies_);
    for (const std::vector<std::uint64_t>* held : {&versions(), &tickets()}) {
      w.array(held->size());
      for (std::uint64_t each : *held) w.natural(each);
    }
    w.natural(steps_).map(4).text("act").real(act_s_).text("step").real(step_s_).text("evaluate").real(evaluate_s_)
        .text("wait").real(std::max(0.0, now - began_s_ - act_s_ - step_s_ - evaluate_s_)).natural(resident_bytes())
        .natural(late_actions_).text("").boolean(run_.type == "WaitSpec");
    link_.send(beat_head_);
    beat_head_.begin("Alive", 2).array(1).array(5).text(options_.name).natural(process_nonce_).text(doing_)
        .real(std::max(0.0, now - since_s_)).natural(env_calls_).array(0);
    link_.send(beat_head_);
  }

  void beat() {  // the second thread
    std::unique_lock lock(mutex_);
    while (!closing_) {
      wake_.wait_for(lock, std::chrono::duration<double>(std::min(0.25, 0.25 * run_.heartbeat_s)));
      if (!closing_ && state_ != State::joining && state_ != State::left) heartbeat_if_due(now_s());
    }
  }

  void welcome(const Message& m) {
    if (m.attempt != attempt_) return;
    const bool again = state_ == State::ready && *m.session == session_;  // the run begins for which this session waits, or a late copy
    if (again && (run_.type != "WaitSpec" || m.run.type == "WaitSpec")) return;
    end();
    state_ = State::ready, session_ = *m.session, run_ = m.run;
    if (!again) replies_ = 0;
    heard_s_ = now_s(), due_s_ = heard_s_ + run_.heartbeat_s;
    join_timeout_s_ = options_.rejoin_timeout_s;
    std::string why = run_.type == "WaitSpec" ? "" : unable(run_);
    if (why.empty() && run_.type != "WaitSpec") why = begin(run_);
    if (!why.empty()) return decline(why);
    if (!again) log("joined");
  }

  std::string unable(const Run& run) const {  // why we are not what the learner asks for, or nothing
    if (run.env != description_.id) return "this client has the environment " + description_.id + ", the learner asks for " + run.env;
    if (!run.beyond.empty()) return "the C++ client does not support " + run.beyond + ", which the learner asks for" + (run.type == "RunSpec" ? "; try --inference learner" : "");
    if (run.vector != "loop") return "the C++ client steps copies one by one, the learner asks for --vector " + run.vector;
    return "";
  }

  void rejoin(const std::string& why) {
    log(why + "; joining again");
    end();
    begin_to_join();
    tick(now_s());
  }

  void replied(const Message& m) {
    if (m.number <= replies_) return;  // a late copy
    replies_ = m.number;
    handle(m);
    for (std::uint64_t lane : lanes()) {
      auto same = [&](const Received& received) { return received.lane == lane; };
      if (std::none_of(m.received.begin(), m.received.end(), same))
        release(lane, std::numeric_limits<std::uint64_t>::max());  // its Release was lost
    }
  }

  void drain(const std::string& why, bool signal) {
    if (state_ == State::joining || (signal && state_ == State::draining)) return leave(0, why);
    state_ = State::draining, reason_ = why;
    if (!busy()) drained();
  }
  void goodbye(const std::string& why) {
    Writer& w = head_.begin("Goodbye", 3).natural(session_).text(line(why)).array(tickets().size());
    for (std::uint64_t ticket : tickets()) w.natural(ticket);
    link_.send(head_);
  }
  void leave(int code, const std::string& why) { state_ = State::left, exit_code_ = code, reason_ = why; }

  void describe(const Message& m) {
    if (const std::string why = unable(m.run); !why.empty()) return decline(why);
    std::vector<std::vector<unsigned char>> bounds;  // the arrays, in the order of their frames
    beat_head_.begin("Described", 3).natural(session_).natural(m.ticket).array(description_.seats.empty() ? 6 : 10);
    space(description_.observation, bounds), space(description_.action, bounds);
    bounds.push_back({0x80});  // an empty dict
    beat_head_.described("|u1", bounds.size(), {1}).text("").natural(description_.longest_episode).text("");
    if (!description_.seats.empty()) {
      beat_head_.array(0).array(0).array(description_.seats.size());
      for (const std::string& seat : description_.seats) beat_head_.text(seat);
      beat_head_.boolean(description_.takes_turns);
    }
    std::vector<Frame> frames;
    for (const std::vector<unsigned char>& bound : bounds) frames.push_back({bound.data(), bound.size()});
    link_.send(beat_head_, frames.data(), frames.size());
  }
  void space(const Space& space, std::vector<std::vector<unsigned char>>& bounds) {
    if (space.kind == "discrete") {
      beat_head_.array(4).text("DiscreteSpace").natural(static_cast<std::uint64_t>(space.n)).whole(space.start).text("int64");
      return;
    }
    beat_head_.array(5).text("BoxSpace").array(space.shape.size());
    for (std::size_t side : space.shape) beat_head_.natural(side);
    beat_head_.text(space.dtype);
    for (const std::vector<double>* bound : {&space.low, &space.high}) {
      bool one = std::all_of(bound->begin(), bound->end(), [&](double each) { return each == bound->front(); });
      std::vector<unsigned char>& bytes = bounds.emplace_back();
      for (double value : *bound) {
        space.append(value, bytes);
        if (one) break;
      }
      one ? beat_head_.described(space.wire(), bounds.size(), {}) : beat_head_.described(space.wire(), bounds.size(), {}, space.shape);
    }
  }

  static std::uint64_t resident_bytes() {
    std::uint64_t all = 0, resident = 0;
    std::ifstream("/proc/self/statm") >> all >> resident;
    return resident * static_cast<std::uint64_t>(sysconf(_SC_PAGESIZE));
  }

  std::optional<Token> token_;
  Link link_;
  Decoder decoder_;
  Message message_;
  Writer beat_head_;
  double join_timeout_s_, joining_s_ = 0, due_s_ = 0, backoff_s_ = 0, heard_s_ = 0, heard_wire_s_ = 0, since_s_ = now_s(), began_s_ = now_s();
  std::uint64_t process_nonce_, attempt_, replies_ = 0, env_calls_ = 0;
  const char* doing_ = "starting";
  char host_[256] = "";
  int exit_code_ = 0, stops_ = 0, unreadable_ = 0;
  std::string reason_;
  bool closing_ = false;
  std::condition_variable wake_;
  std::thread beat_;
};

}  // namespace millrace
