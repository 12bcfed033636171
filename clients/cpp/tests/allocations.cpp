// Counts what this library allocates in its step paths: allocations CORPUS. Prints how many allocations 1000 steps of the
// environment profile made, and how many each of 20 rollouts of the collector profile made, after some to warm up.
#include <cstdlib>
#include <new>

static thread_local bool counting = false;
static thread_local long allocations = 0;
__attribute__((noinline)) void* operator new(std::size_t size) {
  allocations += counting;
  if (void* made = std::malloc(size)) return made;
  throw std::bad_alloc();
}
__attribute__((noinline)) void operator delete(void* made) noexcept { std::free(made); }
__attribute__((noinline)) void operator delete(void* made, std::size_t) noexcept { std::free(made); }

#include "../examples/cartpole.hpp"
#include "corpus.hpp"

class Counted : public millrace::Worker {
 public:
  Counted() : Worker({"inproc://nobody", "counted", ""}, CartPole::description(), [] { return std::make_unique<CartPole>(1); }) {}
  void log(const std::string&) const override {}
  void take(const Frames& frames) {
    views_.clear();
    for (const auto& frame : frames) views_.push_back({frame.data(), frame.size()});
    std::unique_lock lock(mutex_);
    counting = true;
    decoder_.decode(views_, message_);
    if (message_.type == millrace::Type::Welcome) message_.attempt = attempt();
    receive(message_);
    work();
    counting = false;
  }

 private:
  std::vector<millrace::Frame> views_;
  millrace::Decoder decoder_;
  millrace::Message message_;
};

int main(int, char** words) {
  const std::vector<Frames> corpus = read_corpus(words[1]);
  Counted client;
  millrace::Writer head;
  client.take(corpus[2]);  // Welcome, StepSpec
  client.take(corpus[3]);  // Reset
  std::vector<unsigned char> actions(16);
  for (std::uint64_t i = 0; i < 1100; ++i) {
    if (i == 100) allocations = 0;
    actions[0] = i & 1;
    head.begin("Step", 5).natural(77).natural(i + 2).natural(0).natural(0).array(1).described("<i8", 1, {2});
    client.take({head.bytes, actions});
  }
  std::printf("%ld\n", allocations);
  client.take(corpus[9]);  // Rejoin
  client.take(corpus[10]);  // Welcome, RunSpec
  client.take(corpus[12]);  // Weights
  for (std::uint64_t i = 0; i < 40; ++i) {
    if (i == 20) allocations = 0;
    head.begin("Collect", 5).natural(77).natural(3).array(1).array(7).natural(i).natural(0).natural(0).natural(i).natural(i).nil().nil().array(1).array(3).natural(0).natural(0).natural(i).array(1).natural(3);
    client.take({head.bytes});
  }
  std::printf("%ld\n", allocations / 20);
}
