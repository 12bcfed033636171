// Gathering-v0, for tests/clients: three agents of whom each comes, acts, waits, leaves and gets rewards by
// chance. WRONG in the environment makes one mistake: "returns", "waits", "nobody" or "vanishes"; ALL: nobody waits.
#include "../examples/options.hpp"

class Gathering : public millrace::SeatedEnv {
 public:
  static millrace::Description description() {
    return {"Gathering-v0", millrace::Space::box({2}, {-1}, {1e6}), millrace::Space::discrete(3, 1), 40, {"ann", "bob", "cid"}, !all()};
  }
  explicit Gathering(std::uint64_t seed) : random_{seed} {}

  void reset(std::optional<std::uint64_t> seed, std::vector<millrace::Seat>& seats) override {
    if (seed) random_ = millrace::Random{*seed};
    here_ = {}, gone_ = {}, steps_ = 0;
    come(seats);
    if (wrong("nobody")) for (millrace::Seat& seat : seats) seat.acts = false;
  }
  void step(const std::vector<millrace::Action>&, std::vector<millrace::Seat>& seats) override {
    const bool over = ++steps_ == 40 || chance(0.05);
    for (std::size_t a = 0; a < 3; ++a) {
      seats[a].reward = chance(0.5) ? 0.25 * static_cast<double>(random_.bits() % 9) : 0;  // sums are exact
      if (!here_[a]) continue;
      if (over || chance(0.08)) {
        here_[a] = false, gone_[a] = true;
        seats[a].truncated = chance(0.5), seats[a].terminated = !seats[a].truncated || chance(0.5);
        observe(seats[a]);
        if (wrong("vanishes")) seats[a].terminated = seats[a].truncated = false;
      }
    }
    if (!over) come(seats);
    if (wrong("returns") && !over && (gone_[0] || gone_[1])) seats[gone_[0] ? 0 : 1].acts = true;
  }

 private:
  static bool all() { return std::getenv("ALL"); }
  static bool wrong(const std::string& what) { return std::getenv("WRONG") && what == std::getenv("WRONG"); }
  bool chance(float share) { return random_.uniform() < share; }
  void come(std::vector<millrace::Seat>& seats) {
    for (std::size_t a = 0; a < 3; ++a) {
      if (!here_[a] && !gone_[a] && chance(0.4)) here_[a] = true;
      if (here_[a] && (all() ? !wrong("waits") || steps_ < 2 : chance(0.4))) moves(seats[a]);
    }
    for (std::size_t a = 0; a < 3 && std::none_of(seats.begin(), seats.end(), [](const millrace::Seat& seat) { return seat.acts; }); ++a)
      if (!gone_[a]) here_[a] = true, moves(seats[a]);  // somebody, unless all have left
  }
  void moves(millrace::Seat& seat) { observe(seat), seat.acts = true; }
  void observe(const millrace::Seat& seat) {
    float* o = static_cast<float*>(seat.obs);
    o[0] = random_.uniform(), o[1] = static_cast<float>(steps_);
  }

  millrace::Random random_;
  std::array<bool, 3> here_{}, gone_{};
  int steps_ = 0;
};

int main(int count, char** words) { return run_example<Gathering>(count, words); }
