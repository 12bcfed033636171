// The client drives: an engine or a robot that owns its loop asks for an action at each tick (collector profile, one copy).
//
// Rule: `step` never waits for the network. If its action comes later than the deadline, the fallback action is returned and
// counted as late. That row is not learned from: the episode ends as truncated with the row before.
#pragma once
#include "rollouts.hpp"

namespace millrace {

class OwnRows : public Rows {  // the rows of one copy, which the client's program steps
 public:
  using Rows::Rows;
  void result(Rollout& r, double reward, bool terminated, bool truncated, double now) {
    const bool valid = !ended && !gap;
    if (ended) reward = 0;  // this row only resets the copy
    count(reward, now);
    write(r, 0, valid, reward, terminated, truncated);
    check(next_obs_at(r, 0));
    ended = terminated || truncated, gap = false;
    if (ended && valid) report(r, now);
  }
  void not_applied(Rollout& r, double now) {  // the action of this row: call it before `result`
    // The row must not be learned from, so the episode ends as truncated with the row before, and another begins after it.
    if (r.rows && !ended) {
      r.truncated[r.rows - 1] = 1;
      if (r.valid[r.rows - 1]) report(r, now);
    }
    ended = true;
  }
  void outside_of_rows(double reward, bool end, double now) {  // a step that is in no rollout
    count(reward, now);
    ended = end, gap = true;
  }

  bool ended = false, gap = true;  // the next row only resets the copy; does not continue the row before it

 private:
  void count(double reward, double now) {  // a step, or the reset after an end
    if (ended) episode_ = {0, 0, now};
    else episode_.reward += reward, ++episode_.length;
  }
  void report(Rollout& r, double now) {  // steps in no rollout count, as far as the learner can check the length
    r.episodes.push_back({episode_.reward, std::min<std::uint64_t>(episode_.length, (r.sequence + 1) * T), now - episode_.seconds});
  }
  Episode episode_{0, 0, now_s()};  // that runs; `seconds` holds when it began
};

class Agent : public CollectorSession {
 public:
  struct Counts {
    std::uint64_t steps = 0, recorded = 0;  // calls of `step`; those that are rows of rollouts
    std::uint64_t late = 0;                 // the action came after the deadline: the fallback was returned
    std::uint64_t without_policy = 0;       // no weights have arrived yet: the fallback was returned
  };

  // `fallback`: the action, as the environment takes it, when there is no other. It must stay where it is.
  Agent(Options options, Description description, const void* fallback, double deadline_s)
      : CollectorSession(std::move(options), std::move(description)), fallback_(fallback), deadline_s_(deadline_s),
        stored_(description_.action.bytes()), action_(description_.action.bytes()) {
    if (!description_.seats.empty()) throw UsageError("description: expected no agents of an Agent, which is one");
  }

  ~Agent() override { close(); }

  // The action for this observation. `reward` and the flags are of the last action. After the end of an episode, the next
  // call gives the first observation of the next one.
  const void* step(const void* obs, double reward, bool terminated, bool truncated) {
    const double began_s = now_s();
    std::unique_lock lock(mutex_);
    ++counts_.steps;
    now_doing("stepping");
    if (began_s - pumped_s_ > 0.05) work();
    try {
      after(obs, reward, terminated, truncated, began_s);
    } catch (const std::exception& error) {
      if (state_ != State::left) fail(error.what(), rollout_ ? std::optional(rollout_->lane) : std::nullopt);
    }
    if (!rollout_ && state_ == State::ready) begin_rows(obs);
    if (!acts()) return ++counts_.without_policy, late_ = true, fallback_;
    float log_prob;
    policy_.act(obs, evaluation_ ? nullptr : &random_, stored_.data(), &log_prob);
    policy_.to_env(stored_.data(), action_.data());
    if (rollout_) {
      std::copy(stored_.begin(), stored_.end(), static_cast<unsigned char*>(rows_->action_at(*rollout_, 0)));
      *rows_->log_prob_at(*rollout_, 0) = log_prob;
    }
    late_ = now_s() - began_s > deadline_s_;
    counts_.late += late_, late_actions_ = counts_.late;
    return late_ ? fallback_ : action_.data();
  }

  void idle(double until_s) {  // in the slack of your loop: talk to the learner, until 1 ms before this time (of now_s())
    std::unique_lock lock(mutex_);
    do {
      work(until_s - now_s() - 0.002);
    } while (state_ != State::left && until_s - now_s() > 0.003);
  }

  bool left() {  // whether the conversation is over. `step` goes on with the last policy
    std::unique_lock lock(mutex_);
    return state_ == State::left;
  }
  void stop() { stop_requests = stop_requests + 1; }
  const Counts& counts() const { return counts_; }

 protected:
  std::string begin(const Run& run) override {
    if (run.type == "StepSpec") return "this client chooses its own actions; start the learner without --inference learner";
    if (run.copies != 1) return "this client has one env copy, the learner asks for " + std::to_string(run.copies) + " in a lane; give it --envs and --lanes equal to the number of clients";
    if (std::string why = begin_collecting(run); !why.empty()) return why;
    rows_ = std::make_unique<OwnRows>(run, description_.observation, description_.action);  // in the middle of an episode, perhaps
    random_ = Random{run.seed, session_};
    return "";
  }
  std::string no_rows() const override { return "a program that owns its loop does not record episodes; train with --record"; }
  void end() override { rollout_.reset(), evaluation_.reset(), end_collecting(); }
  bool busy() const override { return rollout_ != nullptr; }
  void handle(const Message& message) override {
    handle_collecting(message);
    if (lanes().size() > 1) decline("this client has one env copy, and got two lanes; give the learner --lanes and --envs equal to the number of clients, and --min-workers");
  }

 private:
  void work(double wait_s = 0) { pump(std::max(0.0, wait_s)), pumped_s_ = now_s(); }

  void after(const void* obs, double reward, bool terminated, bool truncated, double now) {  // the last action: what came of it
    const bool end = terminated || truncated;
    if (!rows_) return;
    if (evaluation_) evaluate(reward, end, now);
    if (!rollout_ || !wanted(*rollout_, session_)) {
      rollout_.reset();
      rows_->outside_of_rows(reward, end, now);
      return;
    }
    std::memcpy(rows_->next_obs_at(*rollout_, 0), obs, rows_->obs_bytes);
    if (late_) rows_->not_applied(*rollout_, now);
    rows_->result(*rollout_, reward, terminated, truncated, now);
    ++counts_.recorded;
    if (rows_->end_row(*rollout_)) finished(std::move(rollout_)), drained();
  }

  void begin_rows(const void* obs) {
    if (evaluation_) return;
    if (const Evaluation* order = next_evaluation()) {  // on the one environment that there is, from the next episode on
      if (rows_->ended) evaluation_ = std::make_unique<Playing>(Playing{*order, {}, now_s(), false});
      return;
    }
    rollout_ = next_rollout();
    if (!rollout_) return load_newest();
    std::memcpy(rows_->obs.data(), obs, rows_->obs_bytes);
    rows_->begin(*rollout_);
  }

  struct Playing { Evaluation evaluation; Episode episode; double start_s; bool counts; };
  void evaluate(double reward, bool end, double now) {  // seeds are not used: the client resets its environment as it does
    Playing& p = *evaluation_;
    if (rows_->ended) {  // a new episode began
      p.episode = {}, p.start_s = now, p.counts = true;
      return;
    }
    if (!p.counts) return;
    p.episode.reward += reward, ++p.episode.length;
    if (!end && p.episode.length < p.evaluation.most_steps) return;
    p.episode.seconds = now - p.start_s, p.counts = false;
    p.evaluation.episodes.push_back(p.episode);
    p.evaluation.cut.push_back(!end);
    if (p.evaluation.episodes.size() == p.evaluation.seeds.size()) evaluated(p.evaluation), evaluation_.reset();
  }

  const void* fallback_;
  double deadline_s_, pumped_s_ = 0;
  std::vector<unsigned char> stored_, action_;
  std::unique_ptr<OwnRows> rows_;
  std::unique_ptr<Rollout> rollout_;
  std::unique_ptr<Playing> evaluation_;
  Random random_;
  Counts counts_;
  bool late_ = false;
};

}  // namespace millrace
