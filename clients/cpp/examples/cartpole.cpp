// CartPole in C++ as a worker of a millrace learner: cartpole ADDRESS [--name NAME] [--token FILE]
#include "cartpole.hpp"
#include "options.hpp"

int main(int count, char** words) {
  try {
    std::random_device random;  // a learner that gives seeds replaces these
    millrace::drain_on_signals();
    millrace::Worker worker(options_from(count, words), CartPole::description(), [&] { return std::make_unique<CartPole>(random()); });
    int code = worker.run();
    std::fprintf(stderr, "%s\n", worker.reason().c_str());
    return code;
  } catch (const millrace::UsageError& error) {
    std::fprintf(stderr, "error: %s\n", error.what());
    return 2;
  }
}
