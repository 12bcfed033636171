// Flags-v0: four bytes, of which one is HIGH (1, or 255 as in a picture) and the others 0. The right action is its number.
#include "../examples/options.hpp"
#include "millrace/worker.hpp"

class Flags : public millrace::Env {
 public:
  explicit Flags(unsigned char high) : high_(high) {}
  void reset(std::optional<std::uint64_t> seed, void* obs) override {
    if (seed) random_ = millrace::Random{*seed};
    steps_ = 0, observe(obs);
  }
  millrace::Result step(millrace::Action action, void* obs) override {
    double reward = action.discrete() == up_ ? 1 : 0;
    observe(obs);
    return {reward, false, ++steps_ >= 10};
  }

 private:
  void observe(void* obs) {
    up_ = static_cast<int>(random_.bits() % 4);
    for (int i = 0; i < 4; ++i) static_cast<unsigned char*>(obs)[i] = i == up_ ? high_ : 0;
  }
  unsigned char high_;
  millrace::Random random_;
  int up_ = 0, steps_ = 0;
};

int main(int count, char** words) {
  millrace::drain_on_signals();
  const char* given = std::getenv("HIGH");
  unsigned char high = static_cast<unsigned char>(given ? std::atoi(given) : 1);
  millrace::Description flags{"Flags-v0", millrace::Space::box({4}, {0}, {double(high)}, "uint8"), millrace::Space::discrete(4), 10};
  millrace::Worker worker(options_from(count, words), flags, [high] { return std::make_unique<Flags>(high); });
  return worker.run();
}
