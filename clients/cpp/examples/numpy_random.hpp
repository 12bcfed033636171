// numpy's random generator, as gymnasium's environments use it: PCG64 (O'Neill 2014), seeded through numpy's SeedSequence.
// So a seed gives the same numbers as `np.random.default_rng(seed)`, and as `env.reset(seed=seed)` of an environment in Python.
#pragma once
#include <cstdint>

class NumpyRandom {
 public:
  explicit NumpyRandom(std::uint64_t seed) {
    std::uint32_t constant = 0x43b0d7e5, pool[4] = {}, words[8];
    auto hash = [&](std::uint32_t value) {
      value ^= constant, constant *= 0x931e8875, value *= constant;
      return value ^ value >> 16;
    };
    for (int i = 0; i < 4; ++i) pool[i] = hash(i < 2 ? static_cast<std::uint32_t>(seed >> 32 * i) : 0);
    for (int from = 0; from < 4; ++from)
      for (int to = 0; to < 4; ++to)
        if (from != to) {
          const std::uint32_t mixed = 0xca01f9dd * pool[to] - 0x4973f715 * hash(pool[from]);
          pool[to] = mixed ^ mixed >> 16;
        }
    constant = 0x8b51f9dd;
    for (int i = 0; i < 8; ++i) {
      words[i] = pool[i % 4] ^ constant, constant *= 0x58f38ded, words[i] *= constant;
      words[i] ^= words[i] >> 16;
    }
    auto wide = [&](int i) { return Wide(std::uint64_t(words[i + 1]) << 32 | words[i]) << 64 | (std::uint64_t(words[i + 3]) << 32 | words[i + 2]); };
    increment_ = wide(4) << 1 | 1;
    advance();
    state_ += wide(0);
    advance();
  }
  std::uint64_t bits() {
    advance();
    const std::uint64_t mixed = static_cast<std::uint64_t>(state_ >> 64) ^ static_cast<std::uint64_t>(state_);
    const int turn = static_cast<int>(state_ >> 122);
    return mixed >> turn | mixed << (-turn & 63);
  }
  double uniform() { return static_cast<double>(bits() >> 11) * 0x1p-53; }  // in [0, 1)
  double uniform(double low, double high) { return low + (high - low) * uniform(); }

 private:
  using Wide = unsigned __int128;
  void advance() { state_ = state_ * (Wide(0x2360ED051FC65DA4) << 64 | 0x4385DF649FCCF645) + increment_; }
  Wide state_ = 0, increment_ = 0;
};
