// A program that owns its loop: it controls a cart with a pole at 50 Hz, and learns while it does.
//
//   millrace learner CartPole-v1 --bind tcp://127.0.0.1:5555 --envs 1 --lanes 1
//   control_50hz tcp://127.0.0.1:5555 [--hz 50] [--deadline-ms 2] [--name NAME] [--token FILE]
//
// Its physics is CartPole's; in your program, it is the world. It ends with the run, and prints how late actions were.
#include "cartpole.hpp"
#include "millrace/agent.hpp"
#include "options.hpp"

int main(int count, char** words) {
  try {
    double hz = 50, deadline_s = 0.002;
    std::vector<char*> rest;
    for (int i = 0; i < count; ++i) {
      if (std::string(words[i]) == "--hz" && i + 1 < count) hz = std::atof(words[++i]);
      else if (std::string(words[i]) == "--deadline-ms" && i + 1 < count) deadline_s = std::atof(words[++i]) / 1000;
      else rest.push_back(words[i]);
    }
    millrace::drain_on_signals();
    const std::int64_t push_left = 0;  // the fallback
    millrace::Agent agent(options_from(static_cast<int>(rest.size()), rest.data()), CartPole::description(), &push_left, deadline_s);

    CartPole world{std::random_device()()};
    millrace::Result last;
    float obs[4];
    std::vector<double> latency_s;
    double tick_s = millrace::now_s();
    world.reset(std::nullopt, obs);
    while (!agent.left()) {
      const double asked_s = millrace::now_s();
      const millrace::Action action{agent.step(obs, last.reward, last.terminated, last.truncated)};
      latency_s.push_back(millrace::now_s() - asked_s);
      if (last.terminated || last.truncated) {
        world.reset(std::nullopt, obs);
        last = {};
      } else {
        last = world.step(action, obs);
      }
      tick_s += 1 / hz;
      agent.idle(tick_s);
      const double left_s = tick_s - millrace::now_s();
      if (left_s > 0) std::this_thread::sleep_for(std::chrono::duration<double>(left_s));
    }

    std::sort(latency_s.begin(), latency_s.end());
    auto part = [&](double share) { return 1e6 * latency_s[static_cast<std::size_t>(share * double(latency_s.size() - 1))]; };
    const millrace::Agent::Counts& c = agent.counts();
    std::printf("%llu steps, %llu of them recorded; %llu late, %llu without a policy; an action took %.0f µs (median), %.0f µs (99 %%), %.0f µs (most)\n",
                (unsigned long long)c.steps, (unsigned long long)c.recorded, (unsigned long long)c.late,
                (unsigned long long)c.without_policy, part(0.5), part(0.99), part(1));
    std::fprintf(stderr, "%s\n", agent.reason().c_str());
    return agent.exit_code();
  } catch (const millrace::UsageError& error) {
    std::fprintf(stderr, "error: %s\n", error.what());
    return 2;
  }
}
