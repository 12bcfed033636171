// Pendulum-v1 from gymnasium's equations: a client with Box actions, for tests/clients/test_cpp.py.
#include "../examples/options.hpp"
#include "millrace/worker.hpp"

class Pendulum : public millrace::Env {
 public:
  void reset(std::optional<std::uint64_t> seed, void* obs) override {
    if (seed) random_ = millrace::Random{*seed};
    angle_ = M_PI * (2.0 * random_.uniform() - 1), speed_ = 2.0 * random_.uniform() - 1, steps_ = 0;
    observe(obs);
  }
  millrace::Result step(millrace::Action action, void* obs) override {
    const double torque = action.box()[0];
    if (!(std::abs(torque) <= 2)) throw std::runtime_error("torque: expected -2 to 2, got " + std::to_string(torque));
    const double turned = angle_ + M_PI, from_top = turned - 2 * M_PI * std::floor(turned / (2 * M_PI)) - M_PI;
    const double costs = from_top * from_top + 0.1 * speed_ * speed_ + 0.001 * torque * torque;
    speed_ = std::min(std::max(speed_ + (15 * std::sin(angle_) + 3 * torque) * 0.05, -8.0), 8.0);
    angle_ += speed_ * 0.05;
    observe(obs);
    return {-costs, false, ++steps_ >= 200};
  }

 private:
  void observe(void* obs) const {
    float* o = static_cast<float*>(obs);
    o[0] = float(std::cos(angle_)), o[1] = float(std::sin(angle_)), o[2] = float(speed_);
  }
  millrace::Random random_{1};
  double angle_ = 0, speed_ = 0;
  int steps_ = 0;
};

int main(int count, char** words) {
  millrace::drain_on_signals();
  millrace::Description pendulum{"Pendulum-v1", millrace::Space::box({3}, {-1, -1, -8}, {1, 1, 8}), millrace::Space::box({1}, {-2}, {2}), 200};
  millrace::Worker worker(options_from(count, words), pendulum, [] { return std::make_unique<Pendulum>(); });
  return worker.run();
}
