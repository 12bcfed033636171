// Plays CartPole from given start states: reads lines "x x_dot theta theta_dot N a0 … aN-1" (hexadecimal floats), writes a line
// "x x_dot theta theta_dot reward terminated truncated" (the observation) for each step. The test compares them with gymnasium's.
#include "../examples/cartpole.hpp"

int main() {
  CartPole env;
  std::array<double, 4> start;
  int steps;
  while (std::scanf("%la %la %la %la %d", &start[0], &start[1], &start[2], &start[3], &steps) == 5) {
    float obs[4];
    env.reset(0, obs);
    env.state = start;
    for (long long action; steps-- && std::scanf("%lld", &action) == 1;) {
      std::int64_t number = action;
      millrace::Result result = env.step({&number}, obs);
      std::printf("%a %a %a %a %g %d %d\n", obs[0], obs[1], obs[2], obs[3], result.reward, result.terminated, result.truncated);
    }
  }
}
