// Nim-v0, in which two agents take turns: each takes one to three of up to 20 sticks, and who takes the last one wins.
//
//   millrace learner Nim-v0 --bind tcp://127.0.0.1:5555
//   nim tcp://127.0.0.1:5555 [--name NAME] [--token FILE]
#include "millrace/worker.hpp"
#include "options.hpp"

class Nim : public millrace::SeatedEnv {
 public:
  static millrace::Description description() {
    return {"Nim-v0", millrace::Space::discrete(21), millrace::Space::discrete(3, 1), 20, {"first", "second"}, true};
  }
  explicit Nim(std::uint64_t seed) : random_{seed} {}

  void reset(std::optional<std::uint64_t> seed, std::vector<millrace::Seat>& seats) override {
    if (seed) random_ = millrace::Random{*seed};
    sticks_ = 1 + static_cast<std::int64_t>(random_.bits() % 20), mover_ = 0;
    moves(seats[mover_]);
  }
  void step(const std::vector<millrace::Action>& actions, std::vector<millrace::Seat>& seats) override {
    sticks_ -= std::min(sticks_, actions[mover_].discrete());
    if (sticks_) return moves(seats[mover_ = 1 - mover_]);
    for (millrace::Seat& seat : seats) sees(seat), seat.terminated = true, seat.reward = -1;
    seats[mover_].reward = 1;
  }

 private:
  void sees(millrace::Seat& seat) const { *static_cast<std::int64_t*>(seat.obs) = sticks_; }
  void moves(millrace::Seat& seat) const { sees(seat), seat.acts = true; }

  millrace::Random random_;
  std::int64_t sticks_ = 0;
  std::size_t mover_ = 0;
};

int main(int count, char** words) { return run_example<Nim>(count, words); }
