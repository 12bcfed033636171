// The library drives: it makes your environment, steps it for the learner, and leaves when the learner says so.
//
// The learner decides which profile it is. Environment profile: the learner acts, and we answer Reset and Step. An order is
// executed once; its answer is kept until the lane's next order, and sent again if the order comes again. Collector profile:
// we act under the weights that each ticket names, and send whole rollouts. Rule: once a lane is open, a step allocates nothing.
#pragma once
#include <functional>

#include "seats.hpp"

namespace millrace {

struct Result {
  double reward = 0;
  bool terminated = false;  // the task ended
  bool truncated = false;   // a time limit cut the episode off
};

class Env {  // one env copy with one agent. What it throws ends the client, and the learner is told
 public:
  virtual ~Env() = default;
  virtual void reset(std::optional<std::uint64_t> seed, void* obs) = 0;  // no seed: go on with the same random numbers
  virtual Result step(Action action, void* obs) = 0;
};

class Alone : public SeatedEnv {  // an Env, whose agent acts until its episode ends
 public:
  explicit Alone(std::unique_ptr<Env> env) : env_(std::move(env)) {}
  void reset(std::optional<std::uint64_t> seed, std::vector<Seat>& seats) override { env_->reset(seed, seats[0].obs), seats[0].acts = true; }
  void step(const std::vector<Action>& actions, std::vector<Seat>& seats) override {
    const Result result = env_->step(actions[0], seats[0].obs);
    seats[0] = {seats[0].obs, result.reward, !result.terminated && !result.truncated, result.terminated, result.truncated};
  }

 private:
  std::unique_ptr<Env> env_;
};

class Worker : public CollectorSession {
 public:
  using Make = std::function<std::unique_ptr<Env>()>;
  using MakeSeated = std::function<std::unique_ptr<SeatedEnv>()>;
  Worker(Options options, Description description, Make make)
      : CollectorSession(std::move(options), std::move(description)), make_(make), make_seated_([make] { return std::make_unique<Alone>(make()); }) {
    if (!description_.seats.empty()) throw UsageError("description: expected no agents of an Env, which has one; derive from SeatedEnv");
  }
  Worker(Options options, Description description, MakeSeated make)  // collector profile only
      : CollectorSession(std::move(options), std::move(description)), make_seated_(std::move(make)) {
    if (description_.seats.empty()) throw UsageError("description: expected the names of the agents");
  }

  ~Worker() override { close(); }

  int run() {  // until the conversation is over. Returns the exit code
    std::unique_lock lock(mutex_);
    while (state_ != State::left) {
      pump(0.5);
      while (state_ == State::ready && work()) pump(0);
    }
    return exit_code();
  }

 protected:
  struct Lane {  // of the environment profile
    std::uint64_t incarnation, ticket;
    bool answered = false;
    std::vector<std::unique_ptr<Env>> envs;
    std::vector<unsigned char> obs;
    std::vector<double> reward;
    std::vector<unsigned char> terminated, truncated;
  };

  std::string begin(const Run& run) override {
    if (run.type == "RunSpec") return begin_collecting(run);
    if (!make_) return "an environment with several agents needs a client that acts; start the learner without --inference learner";
    if (run.autoreset == "SameStep") return "the C++ client resets a copy in the next step, the learner asks for autoreset SameStep";
    return other_spaces(run);
  }
  void end() override { lanes_.clear(), collected_.clear(), evaluated_.reset(), end_collecting(); }
  bool busy() const override { return busy_; }
  std::vector<std::uint64_t> lanes() const override {
    std::vector<std::uint64_t> all = CollectorSession::lanes();
    for (auto& [number, lane] : lanes_) all.push_back(number);
    return all;
  }
  const std::vector<std::uint64_t>& tickets() override {
    return run_.type == "StepSpec" ? in_progress_ : CollectorSession::tickets();
  }
  void release(std::uint64_t number, std::uint64_t incarnation) override {
    CollectorSession::release(number, incarnation);
    auto collected = collected_.find(number);
    if (collected != collected_.end() && collected->second->incarnation <= incarnation) collected_.erase(collected);
    auto found = lanes_.find(number);
    if (found != lanes_.end() && found->second.incarnation <= incarnation) lanes_.erase(found);
  }

  void handle(const Message& m) override {
    if (run_.type == "RunSpec") return handle_collecting(m);
    if (m.type != Type::Reset && m.type != Type::Step && m.type != Type::Call) return;
    if (m.lane >= run_.lanes.size()) throw BadMessage("order: expected a lane of the run");
    const std::size_t N = run_.lanes[m.lane];
    check(m, N);
    auto found = lanes_.find(m.lane);
    if (found != lanes_.end()) {
      const Lane& lane = found->second;
      const std::pair order{m.incarnation, m.ticket}, newest{lane.incarnation, lane.ticket};
      if (order < newest) return;  // a late copy
      if (order == newest) return lane.answered && m.type != Type::Call ? answer(m, lane) : void();
      if (m.incarnation > lane.incarnation) lanes_.erase(found), found = lanes_.end();
    }
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
        .described("|u1", 1, {0}).text(line("AttributeError: an environment written in C++ has no attribute " + m.text)).text("");
    send(head_, {{nullptr, 0}});
  }

  // ---------------------------------------------------------------- the collector profile

  struct Collected {  // a lane
    std::uint64_t incarnation;
    std::vector<SeatedCopy> copies;
    SeatRows rows;
    Random random;
  };
  SeatedCopy copy() { return {make_seated_(), std::max<std::size_t>(1, description_.seats.size()), description_.observation, description_.action}; }

  bool work() {  // the next evaluation or rollout; false if there is none
    if (run_.type != "RunSpec") return false;
    if (const Evaluation* order = next_evaluation()) return evaluate(*order), true;
    std::unique_ptr<Rollout> rollout = next_rollout();
    return rollout ? (collect(std::move(rollout)), true) : false;
  }
  void pulse() {  // now and then during long work: handle messages
    if (now_s() >= pulse_due_s_) pump(0), pulse_due_s_ = now_s() + 0.05;
  }

  void collect(std::unique_ptr<Rollout> rollout) {
    const std::uint64_t session = session_, number = rollout->lane;
    busy_ = true;
    try {
      std::shared_ptr<Collected> lane = lane_of(*rollout);  // ours, even if a pulse releases it
      SeatRows& rows = lane->rows;
      for (rows.begin(*rollout);;) {
        pulse();
        if (!wanted(*rollout, session)) break;
        double began_s = now_s();
        for (std::size_t c = 0; c < rows.C; ++c) {
          SeatedCopy& copy = lane->copies[c / rows.A];
          if (!copy.seats[c % rows.A].acts) {
            rows.repeat(*rollout, c);
            continue;
          }
          policy_.act(rows.obs_at(*rollout, c), &lane->random, rows.action_at(*rollout, c), rows.log_prob_at(*rollout, c));
          policy_.to_env(rows.action_at(*rollout, c), copy.action_at(c % rows.A));
          rows.acted(*rollout, c);
        }
        double acted_s = now_s();
        {
          InEnv stepping(*this, "stepping");
          for (std::size_t n = 0; n < rows.N; ++n) {
            if (rows.resets[n]) lane->copies[n].reset(std::nullopt);
            else lane->copies[n].step();
            rows.result(*rollout, n, lane->copies[n], acted_s);
          }
        }
        act_s_ += acted_s - began_s, step_s_ += now_s() - acted_s;
        if (!rows.end_row(*rollout)) continue;
        finished(std::move(rollout));
        break;
      }
      if (rollout) collected_.erase(number);  // abandoned in the middle of its rows
    } catch (const std::exception& error) {
      fail("lane " + std::to_string(number) + ": its environment raised: " + error.what(), number);
    }
    busy_ = false;
    drained();
  }

  std::shared_ptr<Collected> lane_of(const Rollout& r) {  // opened, if this incarnation of it is not yet here
    auto found = collected_.find(r.lane);
    if (found != collected_.end() && found->second->incarnation == r.incarnation) return found->second;
    auto lane = std::make_shared<Collected>(Collected{r.incarnation, {}, SeatRows(run_, description_.observation, description_.action),
                                                      Random{run_.seed, r.lane, r.incarnation}});
    {
      InEnv making(*this, "making");
      for (std::size_t n = 0; n < run_.copies; ++n) {
        lane->copies.push_back(copy());
        lane->copies[n].reset(Random{run_.seed, r.lane, r.incarnation, n + 1}.bits() >> 1);
        lane->rows.started(n, lane->copies[n], now_s());
      }
    }
    return collected_[r.lane] = lane;
  }

  void evaluate(Evaluation evaluation) {  // one episode for each seed, on a copy of its own
    const std::uint64_t session = session_;
    busy_ = true;
    double began_s = now_s();
    try {
      if (!evaluated_) evaluated_ = std::make_shared<SeatedCopy>(copy());
      const std::shared_ptr<SeatedCopy> copy = evaluated_;
      std::vector<unsigned char> stored(description_.action.bytes());
      Random random{evaluation.seeds[0], 1};  // 1: an environment may draw from Random{seed}
      float log_prob;
      for (std::uint64_t seed : evaluation.seeds) {
        double start_s = now_s();
        Episode episode;
        std::vector<double> returns(copy->seats.size());
        auto count = [&] {
          for (std::size_t a = 0; a < returns.size(); ++a) returns[a] += copy->seats[a].reward, episode.reward += copy->seats[a].reward;
        };
        copy->reset(seed), count();
        while (!copy->over() && episode.length < evaluation.most_steps) {
          pulse();
          if (state_ != State::ready || session != session_) return busy_ = false, drained();  // a client that leaves does not finish it
          for (std::size_t a = 0; a < returns.size(); ++a) {
            if (!copy->seats[a].acts) continue;
            policy_.act(copy->seats[a].obs, evaluation.greedy ? nullptr : &random, stored.data(), &log_prob);
            policy_.to_env(stored.data(), copy->action_at(a));
          }
          InEnv evaluating(*this, "evaluating");
          copy->step(), count();
          ++episode.length, ++steps_;
        }
        episode.seconds = now_s() - start_s;
        evaluation.episodes.push_back(episode);
        evaluation.seat_returns.insert(evaluation.seat_returns.end(), returns.begin(), returns.end());
        evaluation.cut.push_back(!copy->over());
      }
    } catch (const std::exception& error) {
      return busy_ = false, fail(std::string("while the policy was evaluated: its environment raised: ") + error.what(), std::nullopt);
    }
    evaluate_s_ += now_s() - began_s;
    busy_ = false;
    evaluated(evaluation);
  }

  Make make_;  // none of an environment with seats
  MakeSeated make_seated_;
  std::map<std::uint64_t, std::shared_ptr<Collected>> collected_;
  std::shared_ptr<SeatedCopy> evaluated_;  // the copy that plays evaluations
  bool busy_ = false;
  double pulse_due_s_ = 0;
  std::map<std::uint64_t, Lane> lanes_;
  std::vector<std::uint64_t> in_progress_;
};

}  // namespace millrace
