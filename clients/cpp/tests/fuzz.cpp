// Feeds mutated messages of a learner to whole clients, built with sanitizers: fuzz CORPUS COUNT worker|agent.
// A worker takes part in both profiles. Prints how many messages were read, and how many were refused as unreadable.
#include <iterator>

#include "../examples/cartpole.hpp"
#include "corpus.hpp"
#include "millrace/agent.hpp"

static millrace::Random random_bits{20261123};
static std::size_t below(std::size_t n) { return n ? random_bits.bits() % n : 0; }
static const std::int64_t fallback = 0;

class Worker : public millrace::Worker {
 public:
  Worker() : millrace::Worker({"inproc://nobody", "victim", ""}, CartPole::description(), [] { return std::make_unique<CartPole>(1); }) {}

 protected:
  void proceed() {
    std::unique_lock lock(mutex_);
    for (int i = 0; i < 4 && state_ == State::ready && work(); ++i) {}
  }
};

class Agent : public millrace::Agent {
 public:
  Agent() : millrace::Agent({"inproc://nobody", "victim", ""}, CartPole::description(), &fallback, 1) { world_.reset(1, obs_); }

 protected:
  void proceed() {
    for (int i = 0; i < 8; ++i) {
      const millrace::Action action{step(obs_, last_.reward, last_.terminated, last_.truncated)};
      const bool ended = last_.terminated || last_.truncated;
      last_ = ended ? millrace::Result{} : world_.step(action, obs_);
      if (ended) world_.reset(std::nullopt, obs_);
    }
  }

 private:
  CartPole world_;
  millrace::Result last_;
  float obs_[4];
};

template <class Client>
class Victim : public Client {
 public:
  bool take(const Frames& frames) {  // as if they had come from the socket; whether they could be read
    std::vector<millrace::Frame> views;
    std::vector<std::unique_ptr<unsigned char[]>> exact;  // so that a read beyond the end is seen
    for (const Bytes& frame : frames) {
      exact.emplace_back(new unsigned char[frame.size()]);
      std::copy(frame.begin(), frame.end(), exact.back().get());
      views.push_back({exact.back().get(), frame.size()});
    }
    try {
      std::unique_lock lock(this->mutex_);
      decoder_.decode(views, message_);
      if (message_.type == millrace::Type::Welcome) message_.attempt = this->attempt();
      this->receive(message_);
    } catch (const millrace::BadMessage&) {
      return false;
    }
    this->proceed();
    return true;
  }
  void log(const std::string&) const override {}
  bool over() const { return this->state_ == Client::State::left; }

 private:
  millrace::Decoder decoder_;
  millrace::Message message_;
};

static void mutate(Frames& frames) {
  for (std::size_t times = below(4); times--;) {
    Bytes& frame = frames[below(3) ? 0 : below(frames.size())];
    const std::size_t at = below(frame.size());
    switch (below(8)) {
      case 0: if (!frame.empty()) frame[at] ^= static_cast<unsigned char>(1u << below(8)); break;
      case 1: if (!frame.empty()) frame[at] = static_cast<unsigned char>(random_bits.bits()); break;
      case 2: frame.resize(at); break;
      case 3: frame.insert(frame.begin() + static_cast<std::ptrdiff_t>(at), static_cast<unsigned char>(random_bits.bits())); break;
      case 4: if (!frame.empty()) frame.erase(frame.begin() + static_cast<std::ptrdiff_t>(at)); break;
      case 5: frames.push_back(Bytes(below(40))); break;
      case 6: if (frames.size() > 1) frames.pop_back(); break;
      default: {  // an extreme number or length
        static const Bytes extremes[] = {{0xcf, 255, 255, 255, 255, 255, 255, 255, 255}, {0xcf, 0, 32, 0, 0, 0, 0, 0, 0}, {0xd3, 128, 0, 0, 0, 0, 0, 0, 0},
                                         {0xdd, 255, 255, 255, 255}, {0xdf, 255, 255, 255, 255}, {0xdb, 255, 255, 255, 255}, {0xc6, 255, 255, 255, 255},
                                         {0xcb, 127, 240, 0, 0, 0, 0, 0, 0}, {0xcb, 127, 248, 0, 0, 0, 0, 0, 0}, {0xff}, {0xc0}, {0xcd, 255, 255}, {0xce, 64, 0, 0, 0}};
        const Bytes& extreme = extremes[below(std::size(extremes))];
        if (!frame.empty()) frame.erase(frame.begin() + static_cast<std::ptrdiff_t>(at));
        frame.insert(frame.begin() + static_cast<std::ptrdiff_t>(at), extreme.begin(), extreme.end());
      }
    }
  }
}

template <class Client>
void fuzz(const std::vector<Frames>& corpus, long left) {
  long read = 0, unreadable = 0;
  while (left > 0) {
    Victim<Client> victim;  // until it leaves, or for some messages
    for (std::size_t i = 0, start = below(2) ? 0 : 10; i < 300 && left > 0 && !victim.over(); ++i, --left) {
      Frames frames = corpus[i < corpus.size() - start ? start + i : below(corpus.size())];
      if (i) mutate(frames);
      victim.take(frames) ? ++read : ++unreadable;
    }
  }
  std::printf("%ld read, %ld unreadable\n", read, unreadable);
}

int main(int count, char** words) {
  if (count != 4) return 2;
  const auto chosen = std::string(words[3]) == "agent" ? fuzz<Agent> : fuzz<Worker>;
  chosen(read_corpus(words[1]), std::atol(words[2]));
}
