// Env copies with one agent or several, and the rows of a lane of them.
//
// Rule: a seat is an agent's place in a copy, and its column in a rollout. Its row is the one in which the outcome of its action
// comes: when it acts again, or its part of the episode ends. Until then each row repeats what it did, and the observation in
// which it did so. The episode is over when no seat acts: the next step only resets the copy.
#pragma once
#include "rollouts.hpp"

namespace millrace {

struct Action {  // views of what the policy or the learner chose
  const void* data;
  std::int64_t discrete() const { return *static_cast<const std::int64_t*>(data); }  // counted from the space's start
  const float* box() const { return static_cast<const float*>(data); }
};

struct Seat {  // what a reset or a step means for an agent. The library sets all but `obs` to 0 before
  void* obs;              // what it sees is written here where it acts next, or its part ends; it is kept until it is written again
  double reward = 0;      // in this step, whether or not it acted
  bool acts = false;      // the next step takes its action
  bool terminated = false, truncated = false;  // its part of the episode ends: the task itself, or by a time limit
};

class SeatedEnv {  // one env copy with several agents, in the order of `Description::seats`
 public:
  virtual ~SeatedEnv() = default;
  virtual void reset(std::optional<std::uint64_t> seed, std::vector<Seat>& seats) = 0;  // no seed: go on with the same random numbers
  virtual void step(const std::vector<Action>& actions, std::vector<Seat>& seats) = 0;  // those of seats that do not act mean nothing
};

class SeatedCopy {  // an env copy, with what it is called with
 public:
  SeatedCopy(std::unique_ptr<SeatedEnv> env, std::size_t A, const Space& observation, const Space& action)
      : seats(A), env_(std::move(env)), obs_(A * observation.bytes()), actions_(A * action.bytes()), action_bytes_(action.bytes()) {
    for (std::size_t a = 0; a < A; ++a) seats[a].obs = &obs_[a * observation.bytes()], views_.push_back({action_at(a)});
  }
  void* action_at(std::size_t a) { return &actions_[a * action_bytes_]; }
  void reset(std::optional<std::uint64_t> seed) {
    clear(), env_->reset(seed, seats);
    if (over()) throw std::runtime_error("reset: expected an agent that acts");
  }
  void step() { clear(), env_->step(views_, seats); }
  bool over() const {
    return std::none_of(seats.begin(), seats.end(), [](const Seat& seat) { return seat.acts; });
  }

  std::vector<Seat> seats;

 private:
  void clear() {
    for (Seat& seat : seats) seat = Seat{seat.obs};
  }
  std::unique_ptr<SeatedEnv> env_;
  std::vector<unsigned char> obs_, actions_;
  std::size_t action_bytes_;
  std::vector<Action> views_;
};

class SeatRows : public Rows {
 public:
  SeatRows(const Run& run, const Space& observation, const Space& action)
      : Rows(run, observation, action), N(run.copies), A(C / N), resets(N), names_(run.seats), takes_turns_(run.takes_turns), columns_(C), held_(C * action_bytes),
        episodes_(N) {
    const std::vector<unsigned char> any = observation.any();  // who has seen nothing yet shows this
    for (std::size_t c = 0; c < C; ++c) std::copy(any.begin(), any.end(), &obs[c * obs_bytes]);
  }

  void started(std::size_t n, const SeatedCopy& copy, double now) {  // an episode of copy n began outside of a row
    begin_episode(n, now);
    for (std::size_t a = 0; a < A; ++a) {
      const Seat& seat = copy.seats[a];
      if (seat.acts) std::memcpy(&obs[(n * A + a) * obs_bytes], seat.obs, obs_bytes), check(seat.obs);
      columns_[n * A + a].total += seat.reward;
    }
  }
  void begin(Rollout& r) {
    Rows::begin(r);
    r.resets.resize((T + 1) * N);
    std::copy(resets.begin(), resets.end(), r.resets.begin());
  }
  void acted(Rollout& r, std::size_t c) {  // its action and log_prob are in this row
    std::memcpy(&held_[c * action_bytes], action_at(r, c), action_bytes);
    columns_[c].log_prob = *log_prob_at(r, c), columns_[c].waits = true, columns_[c].due = 0;
  }
  void repeat(Rollout& r, std::size_t c) {  // it does not act in this row
    std::memcpy(action_at(r, c), &held_[c * action_bytes], action_bytes);
    *log_prob_at(r, c) = columns_[c].log_prob;
  }
  void result(Rollout& r, std::size_t n, const SeatedCopy& copy, double now) {  // of copy n in this row
    if (resets[n]) begin_episode(n, now);
    else ++episodes_[n].length;
    const bool over = copy.over();
    for (std::size_t a = 0; a < A; ++a) {
      const Seat& seat = copy.seats[a];
      const std::size_t c = n * A + a;
      Column& column = columns_[c];
      const bool ends = seat.terminated || seat.truncated, complete = column.waits && (seat.acts || ends);
      column.total += seat.reward, column.due += seat.reward;
      if (column.waits && !complete && (over || !takes_turns_))
        throw std::runtime_error("agent " + names_[a] + ": expected that it acts again, or that its part of the episode ends");
      column.left |= complete && ends;
      if (seat.acts && column.left) throw std::runtime_error("agent " + names_[a] + ": expected no action after its part of the episode");
      write(r, c, complete, complete ? column.due : 0, complete && seat.terminated, complete && seat.truncated);
      column.waits &= !complete;
      const bool sees = seat.acts || complete;
      std::memcpy(next_obs_at(r, c), sees ? seat.obs : obs_at(r, c), obs_bytes);
      if (sees) check(seat.obs);
    }
    r.resets[(r.rows + 1) * N + n] = resets[n] = over;
    if (over) report(r, n, now);
  }

  const std::size_t N, A;
  std::vector<unsigned char> resets;  // [N] the next row only resets this copy

 private:
  struct Column {  // of a seat
    bool waits = false, left = false;  // it has acted, and its row is not complete; its part of the episode has ended
    float log_prob = 0;                // of what it did last
    double due = 0, total = 0;         // rewards since then, and of the episode
  };
  void begin_episode(std::size_t n, double now) {
    episodes_[n] = {0, 0, now};  // `seconds` holds when it began
    for (std::size_t c = n * A; c < (n + 1) * A; ++c) columns_[c].left = false, columns_[c].total = 0;
  }
  void report(Rollout& r, std::size_t n, double now) {
    Episode episode{0, episodes_[n].length, now - episodes_[n].seconds};
    for (std::size_t c = n * A; c < (n + 1) * A; ++c) episode.reward += columns_[c].total, r.seat_returns.push_back(columns_[c].total);
    r.episodes.push_back(episode);
  }

  const std::vector<std::string> names_;
  const bool takes_turns_;
  std::vector<Column> columns_;
  std::vector<unsigned char> held_;  // [C, …] what each seat did last
  std::vector<Episode> episodes_;    // that run
};

}  // namespace millrace
