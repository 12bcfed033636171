// CartPole-v1 from the equations of Barto, Sutton and Anderson (1983), as gymnasium has them: the state in double precision,
// Euler's method, observations rounded to float32. The same start state and actions give the same bits as gymnasium.
// An episode ends as terminated when the pole or the cart leaves its bounds, and as truncated after 500 steps.
//
// Random numbers: numpy's, as gymnasium's. A start state is four numbers, uniform in [-0.05, 0.05); so a seed gives the same
// episodes as in Python, and a learner that acts for this client learns the same weights, bit for bit.
#pragma once
#include <cmath>

#include "millrace/worker.hpp"
#include "numpy_random.hpp"

class CartPole : public millrace::Env {
 public:
  static constexpr double X_BOUND = 2.4, ANGLE_BOUND = 12 * 2 * M_PI / 360;

  static millrace::Description description() {
    const double inf = std::numeric_limits<double>::infinity();
    const double x = float(2 * X_BOUND), angle = float(2 * ANGLE_BOUND);
    return {"CartPole-v1", millrace::Space::box({4}, {-x, -inf, -angle, -inf}, {x, inf, angle, inf}), millrace::Space::discrete(2), 500};
  }

  explicit CartPole(std::uint64_t seed = 0) : random_(seed) {}

  void reset(std::optional<std::uint64_t> seed, void* obs) override {
    if (seed) random_ = NumpyRandom(*seed);
    for (double& each : state) each = random_.uniform(-0.05, 0.05);
    steps_ = 0;
    observe(obs);
  }

  millrace::Result step(millrace::Action action, void* obs) override {
    auto [x, x_dot, theta, theta_dot] = state;
    const double force = action.discrete() == 1 ? 10.0 : -10.0, total = 0.1 + 1.0, pole = 0.1 * 0.5;
    const double cosine = std::cos(theta), sine = std::sin(theta);
    const double temp = (force + pole * (theta_dot * theta_dot) * sine) / total;
    const double theta_acc = (9.8 * sine - cosine * temp) / (0.5 * (4.0 / 3.0 - 0.1 * (cosine * cosine) / total));
    const double x_acc = temp - pole * theta_acc * cosine / total;
    state = {x + 0.02 * x_dot, x_dot + 0.02 * x_acc, theta + 0.02 * theta_dot, theta_dot + 0.02 * theta_acc};
    ++steps_;
    observe(obs);
    const bool fell = std::abs(state[0]) > X_BOUND || std::abs(state[2]) > ANGLE_BOUND;
    return {1.0, fell, steps_ >= 500};
  }

  std::array<double, 4> state{};  // position (m), velocity, angle (rad), angular velocity

 private:
  void observe(void* obs) const { std::copy(state.begin(), state.end(), static_cast<float*>(obs)); }

  NumpyRandom random_;
  int steps_ = 0;
};
