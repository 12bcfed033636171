// Corridor-v0, an environment that exists in this file and in clients/js/tests/corridor.js only: from 0 to 5, with steps of 1.
#include "../examples/options.hpp"
#include "millrace/worker.hpp"

class Corridor : public millrace::Env {
 public:
  void reset(std::optional<std::uint64_t>, void* obs) override { at_ = steps_ = 0, observe(obs); }
  millrace::Result step(millrace::Action action, void* obs) override {
    at_ += action.discrete() == 1 ? 1 : -1;
    observe(obs);
    return {at_ == 5 ? 1 : -0.01, at_ == 5, ++steps_ >= 50};
  }

 private:
  void observe(void* obs) const { *static_cast<float*>(obs) = float(at_); }
  int at_ = 0, steps_ = 0;
};

int main(int count, char** words) {
  millrace::drain_on_signals();
  millrace::Description corridor{"Corridor-v0", millrace::Space::box({1}, {-50}, {5}), millrace::Space::discrete(2), 50};
  millrace::Worker worker(options_from(count, words), corridor, [] { return std::make_unique<Corridor>(); });
  return worker.run();
}
