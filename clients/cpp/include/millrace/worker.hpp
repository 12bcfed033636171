// The library drives: it makes your environment, steps it for the learner, and leaves when the learner says so.
//
// Rule (environment profile): an order is executed once; its answer is kept until the lane's next order, and sent again
// if the order comes again. A step allocates nothing once the lane is open.
#pragma once
#include <functional>

#include "session.hpp"

namespace millrace {

struct Action {  // views of what the learner sent
  const void* data;
  std::int64_t discrete() const { return *static_cast<const std::int64_t*>(data); }  // counted from the space's start
  const float* box() const { return static_cast<const float*>(data); }
};

struct Result {
  double reward = 0;
  bool terminated = false;  // the task ended
  bool truncated = false;   // a time limit cut the episode off
};

class Env {  // one env copy. What it throws ends the client, and the learner is told
 public:
  virtual ~Env() = default;
  virtual void reset(std::optional<std::uint64_t> seed, void* obs) = 0;  // no seed: go on with the same random numbers
  virtual Result step(Action action, void* obs) = 0;
};

class Worker : public Session {
 public:
  using Make = std::function<std::unique_ptr<Env>()>;
  Worker(Options options, Description description, Make make)
      : Session(std::move(options), std::move(description)), make_(std::move(make)) {}

  int run() {  // until the conversation is over. Returns the exit code
    std::unique_lock lock(mutex_);
    while (state_ != State::left) pump(0.5);
    return exit_code();
  }

 protected:
  struct Lane {
    std::uint64_t incarnation, ticket;
    bool answered = false;
    std::vector<std::unique_ptr<Env>> envs;
    std::vector<unsigned char> obs;
    std::vector<double> reward;
    std::vector<unsigned char> terminated, truncated;
  };

  std::string begin(const Run& run) override {
    if (run.type != "StepSpec") return "this client only steps environments; start the learner with --inference learner";
    if (run.autoreset == "SameStep") return "the C++ client resets a copy in the next step, the learner asks for autoreset SameStep";
    return spaces_of(run);
  }
  std::string spaces_of(const Run& run) const {
    bool same = run.observation.size() == 1 && run.action.size() == 1 && description_.observation.is(run.observation[0]) &&
                description_.action.is(run.action[0]);
    return same ? "" : "environment " + description_.id + ": its observations or actions are not what the learner has; build both from the same version";
  }
  void end() override { lanes_.clear(); }
  std::vector<std::uint64_t> lanes() const override {
    std::vector<std::uint64_t> all;
    for (auto& [number, lane] : lanes_) all.push_back(number);
    return all;
  }
  const std::vector<std::uint64_t>& tickets() override { return in_progress_; }
  void release(std::uint64_t number, std::uint64_t incarnation) override {
    auto found = lanes_.find(number);
    if (found != lanes_.end() && found->second.incarnation <= incarnation) lanes_.erase(found);
  }

  void handle(const Message& m) override {
    if (m.type != Type::Reset && m.type != Type::Step && m.type != Type::Call) return;
    if (m.lane >= run_.lanes.size()) throw BadMessage("order: expected a lane of the run");
    auto found = lanes_.find(m.lane);
    if (found != lanes_.end()) {
      Lane& lane = found->second;
      if (m.incarnation < lane.incarnation || (m.incarnation == lane.incarnation && m.ticket < lane.ticket)) return;
      if (m.incarnation == lane.incarnation && m.ticket == lane.ticket) return lane.answered && m.type != Type::Call ? answer(m, lane) : void();
      if (m.incarnation > lane.incarnation) lanes_.erase(found), found = lanes_.end();
    }
    const std::size_t N = run_.lanes[m.lane];
    check(m, N);
    in_progress_.assign(1, m.ticket);
    try {
      Lane& lane = found == lanes_.end() ? open(m, N) : found->second;
      lane.ticket = m.ticket, lane.answered = false;
      execute(m, lane);
      lane.answered = true;
      if (m.type == Type::Call) returned(m);
      else answer(m, lane);
    } catch (const std::exception& error) {
      fail("lane " + std::to_string(m.lane) + ": its environment raised: " + error.what(), m.lane);
    }
    in_progress_.clear();
  }

  void check(const Message& m, std::size_t N) const {
    for (std::uint64_t copy : m.copies)
      if (copy >= N) throw BadMessage("Reset: expected copies of the lane");
    if (m.type != Type::Step) return;
    const std::vector<std::size_t>& shape = description_.action.shape;
    bool fits = m.arrays.size() == 1 && m.arrays[0].dtype == description_.action.wire() &&
                m.arrays[0].dimensions == 1 + shape.size() && m.arrays[0].shape[0] == N &&
                std::equal(shape.begin(), shape.end(), m.arrays[0].shape.begin() + 1);
    if (!fits) throw BadMessage("Step: expected one action for each copy");
  }

  Lane& open(const Message& m, std::size_t N) {
    Lane lane{m.incarnation, m.ticket, false, {}, {}, {}, {}, {}};
    {
      InEnv making(*this, "making");
      for (std::size_t n = 0; n < N; ++n) lane.envs.push_back(make_());
    }
    lane.obs.resize(N * description_.observation.bytes());
    lane.reward.resize(N), lane.terminated.resize(N);
    lane.truncated.assign(N, 1);  // a step resets the copies, unless a Reset did
    return lanes_.insert_or_assign(m.lane, std::move(lane)).first->second;
  }

  void execute(const Message& m, Lane& lane) {
    double began_s = now_s();
    const std::size_t bytes = description_.observation.bytes();
    if (m.type == Type::Reset) {
      InEnv resetting(*this, "resetting");
      for (std::size_t i = 0; i < m.copies.size(); ++i) {
        std::size_t n = m.copies[i];
        lane.envs[n]->reset(m.seeds[i], &lane.obs[n * bytes]);
        lane.reward[n] = 0, lane.terminated[n] = lane.truncated[n] = 0;
      }
    } else if (m.type == Type::Step) {
      InEnv stepping(*this, "stepping");
      const char* action = static_cast<const char*>(m.arrays[0].data);
      for (std::size_t n = 0; n < lane.envs.size(); ++n, action += description_.action.bytes()) {
        if ((lane.terminated[n] || lane.truncated[n]) && run_.autoreset == "NextStep") {
          lane.envs[n]->reset(std::nullopt, &lane.obs[n * bytes]);
          lane.reward[n] = 0, lane.terminated[n] = lane.truncated[n] = 0;
        } else {
          Result result = lane.envs[n]->step({action}, &lane.obs[n * bytes]);
          lane.reward[n] = result.reward, lane.terminated[n] = result.terminated, lane.truncated[n] = result.truncated;
        }
      }
      steps_ += lane.envs.size();
    }
    step_s_ += now_s() - began_s;
  }

  void answer(const Message& m, const Lane& lane) {  // Stepped
    const std::size_t N = lane.envs.size();
    head_.begin("Stepped", 9).natural(session_).natural(lane.ticket).natural(m.lane).natural(lane.incarnation).array(1)
        .described(description_.observation.wire(), 1, {N}, description_.observation.shape).described("<f8", 2, {N})
        .described("|b1", 3, {N}).described("|b1", 4, {N}).described("|u1", 5, {0});
    send(head_, {{lane.obs.data(), lane.obs.size()}, {lane.reward.data(), 8 * N}, {lane.terminated.data(), N},
                 {lane.truncated.data(), N}, {nullptr, 0}});
  }
  void returned(const Message& m) {
    head_.begin("Returned", 7).natural(session_).natural(m.ticket).natural(m.lane).natural(m.incarnation)
        .described("|u1", 1, {0}).text("AttributeError: an environment written in C++ has no attribute " + m.text.substr(0, 100)).text("");
    send(head_, {{nullptr, 0}});
  }

  Make make_;
  std::map<std::uint64_t, Lane> lanes_;
  std::vector<std::uint64_t> in_progress_;
};

}  // namespace millrace
