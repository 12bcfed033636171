// Feeds mutated messages of a learner to a whole client, in both profiles: fuzz CORPUS COUNT. Built with sanitizers.
// Prints how many messages were read, and how many were refused as unreadable.
#include <fstream>
#include <iterator>

#include "../examples/cartpole.hpp"

using Bytes = std::vector<unsigned char>;
using Frames = std::vector<Bytes>;

static millrace::Random random_bits{20261123};
static std::size_t below(std::size_t n) { return n ? random_bits.bits() % n : 0; }

class Victim : public millrace::Worker {
 public:
  Victim() : Worker({"inproc://nobody", "victim", ""}, CartPole::description(), [] { return std::make_unique<CartPole>(1); }) {}
  bool take(const Frames& frames) {  // as if they had come from the socket; whether they could be read
    std::unique_lock lock(mutex_);
    std::vector<millrace::Frame> views;
    std::vector<std::unique_ptr<unsigned char[]>> exact;  // so that a read beyond the end is seen
    for (const Bytes& frame : frames) {
      exact.emplace_back(new unsigned char[frame.size()]);
      std::copy(frame.begin(), frame.end(), exact.back().get());
      views.push_back({exact.back().get(), frame.size()});
    }
    try {
      decoder.decode(views, message);
    } catch (const millrace::BadMessage&) {
      return false;
    }
    if (message.type == millrace::Type::Welcome) message.attempt = attempt();
    try {
      receive(message);
      for (int i = 0; i < 4 && state_ == State::ready && work(); ++i) {}
    } catch (const millrace::BadMessage&) {
      return false;
    }
    return true;
  }
  void log(const std::string&) const override {}
  bool over() const { return state_ == State::left; }
  millrace::Decoder decoder;
  millrace::Message message;
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

int main(int count, char** words) {
  if (count != 3) return 2;
  std::ifstream file(words[1], std::ios::binary);
  std::vector<Frames> corpus;
  std::uint32_t number;
  auto next = [&] { return bool(file.read(reinterpret_cast<char*>(&number), 4)); };
  while (next()) {
    corpus.emplace_back(number);
    for (Bytes& frame : corpus.back()) next(), frame.resize(number), file.read(reinterpret_cast<char*>(frame.data()), number);
  }
  long read = 0, unreadable = 0, left = std::atol(words[2]);
  while (left > 0) {
    Victim victim;  // until it leaves, or for some messages
    for (std::size_t i = 0, start = below(2) ? 0 : 9; i < 300 && left > 0 && !victim.over(); ++i, --left) {
      Frames frames = corpus[i < corpus.size() - start ? start + i : below(corpus.size())];
      if (i) mutate(frames);
      victim.take(frames) ? ++read : ++unreadable;
    }
  }
  std::printf("%ld read, %ld unreadable\n", read, unreadable);
}
