// Reads valid messages of a learner from a file of tests/clients/messages_to_clients.py.
#pragma once
#include <cstdint>
#include <fstream>
#include <vector>

using Bytes = std::vector<unsigned char>;
using Frames = std::vector<Bytes>;

inline std::vector<Frames> read_corpus(const char* path) {
  std::ifstream file(path, std::ios::binary);
  std::vector<Frames> corpus;
  std::uint32_t number;
  auto next = [&] { return bool(file.read(reinterpret_cast<char*>(&number), 4)); };
  while (next()) {
    corpus.emplace_back(number);
    for (Bytes& frame : corpus.back()) next(), frame.resize(number), file.read(reinterpret_cast<char*>(frame.data()), number);
  }
  return corpus;
}
