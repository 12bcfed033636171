// Tag-v0, in which three agents act at the same time: on a ring of 12 fields a chaser catches two runners, who leave then.
//
//   millrace learner Tag-v0 --bind tcp://127.0.0.1:5555
//   tag tcp://127.0.0.1:5555 [--name NAME] [--token FILE]
#include "millrace/worker.hpp"
#include "options.hpp"

class Tag : public millrace::SeatedEnv {
 public:
  static millrace::Description description() {
    return {"Tag-v0", millrace::Space::box({3}, {-1}, {1}), millrace::Space::discrete(3), 30, {"chaser", "runner_0", "runner_1"}};
  }
  explicit Tag(std::uint64_t seed) : random_{seed} {}

  void reset(std::optional<std::uint64_t> seed, std::vector<millrace::Seat>& seats) override {
    if (seed) random_ = millrace::Random{*seed};
    at_ = {0, 2 + field(9), 2 + field(9)}, caught_ = {}, steps_ = 0;
    for (std::size_t a = 0; a < 3; ++a) observe(a, seats[a]), seats[a].acts = true;
  }
  void step(const std::vector<millrace::Action>& actions, std::vector<millrace::Seat>& seats) override {
    std::array<bool, 3> here;
    for (std::size_t a = 0; a < 3; ++a)
      if ((here[a] = !caught_[a])) at_[a] = (at_[a] + static_cast<int>(actions[a].discrete()) + 11) % 12;  // one back, none, or one on
    for (std::size_t a : {1, 2}) {
      if (!here[a]) continue;
      caught_[a] = at_[a] == at_[0];
      seats[a].terminated = caught_[a], seats[a].reward = caught_[a] ? -1 : 0.1, seats[0].reward += caught_[a] ? 1 : 0;
    }
    seats[0].terminated = caught_[1] && caught_[2];
    const bool late = ++steps_ == 30;
    for (std::size_t a = 0; a < 3; ++a) {
      if (!here[a]) continue;
      observe(a, seats[a]);
      seats[a].truncated = late && !seats[a].terminated;
      seats[a].acts = !seats[a].terminated && !seats[a].truncated;
    }
  }

 private:
  int field(std::uint64_t fields) { return static_cast<int>(random_.bits() % fields); }
  void observe(std::size_t self, const millrace::Seat& seat) const {  // who it is, and how far the others are; 0: caught
    float* o = static_cast<float*>(seat.obs);
    *o++ = self == 0 ? 1 : -1;
    for (std::size_t a = 0; a < 3; ++a)
      if (a != self) {
        const int apart = (at_[a] - at_[self] + 12) % 12;
        *o++ = caught_[a] ? 0 : static_cast<float>(apart > 6 ? apart - 12 : apart) / 6;
      }
  }

  millrace::Random random_;
  std::array<int, 3> at_{};
  std::array<bool, 3> caught_{};
  int steps_ = 0;
};

int main(int count, char** words) { return run_example<Tag>(count, words); }
