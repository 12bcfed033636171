// Reads and writes the head of a message: the part of msgpack that the wire document uses. Allocates nothing while it reads.
//
// Rule: every length is checked against the bytes that are left, before anything is done with it. What cannot be read
// throws BadMessage, and nothing else happens.
#pragma once
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace millrace {

struct BadMessage : std::runtime_error {
  using std::runtime_error::runtime_error;
};

class Reader {  // one value after another
 public:
  Reader(const void* data, std::size_t size) : at_(static_cast<const std::uint8_t*>(data)), end_(at_ + size) {}

  bool nil() { return left() && *at_ == 0xc0 ? (++at_, true) : false; }  // consumes nil if it is next
  bool is_array() const { return left() && ((*at_ & 0xf0) == 0x90 || *at_ == 0xdc || *at_ == 0xdd); }
  bool is_map() const { return left() && ((*at_ & 0xf0) == 0x80 || *at_ == 0xde || *at_ == 0xdf); }
  bool done() const { return left() == 0; }

  std::size_t array() {  // the number of items that follow
    std::uint8_t code = byte();
    return count(code == 0xdc ? big(2) : code == 0xdd ? big(4) : (code & 0xf0) == 0x90 ? code & 0x0f : fail("an array"), 1);
  }
  std::size_t map() {  // the number of pairs that follow
    std::uint8_t code = byte();
    return count(code == 0xde ? big(2) : code == 0xdf ? big(4) : (code & 0xf0) == 0x80 ? code & 0x0f : fail("a map"), 2);
  }
  std::string_view text(std::size_t most = SIZE_MAX) {
    std::uint8_t code = byte();
    std::uint64_t size = code == 0xd9 ? big(1) : code == 0xda ? big(2) : code == 0xdb ? big(4)
                         : (code & 0xe0) == 0xa0 ? code & 0x1f : fail("text");
    if (size > most) fail("a shorter text");
    return {reinterpret_cast<const char*>(take(size)), static_cast<std::size_t>(size)};
  }
  std::int64_t whole() {
    std::uint8_t code = byte();
    if (code < 0x80 || code >= 0xe0) return static_cast<std::int8_t>(code);
    if (code >= 0xcc && code <= 0xcf) {
      std::uint64_t value = big(1u << (code - 0xcc));
      return value > INT64_MAX ? static_cast<std::int64_t>(fail("a smaller number")) : static_cast<std::int64_t>(value);
    }
    switch (code) {
      case 0xd0: return static_cast<std::int8_t>(big(1));
      case 0xd1: return static_cast<std::int16_t>(big(2));
      case 0xd2: return static_cast<std::int32_t>(big(4));
      case 0xd3: return static_cast<std::int64_t>(big(8));
      default: return static_cast<std::int64_t>(fail("a whole number"));
    }
  }
  std::uint64_t natural() {
    std::int64_t value = whole();
    if (value < 0 || value > LARGEST) fail("a number from 0 to 2^53");
    return static_cast<std::uint64_t>(value);
  }
  double real() {
    if (!left() || (*at_ != 0xca && *at_ != 0xcb)) return static_cast<double>(whole());
    bool wide = byte() == 0xcb;
    std::uint64_t bits = big(wide ? 8 : 4);
    std::uint32_t half = static_cast<std::uint32_t>(bits);
    double value;
    float narrow;
    std::memcpy(&value, &bits, 8);
    std::memcpy(&narrow, &half, 4);
    return wide ? value : narrow;
  }
  bool boolean() {
    std::uint8_t code = byte();
    return code == 0xc3 || (code != 0xc2 && fail("true or false"));
  }
  void skip(int depth = 0) {
    if (depth > 32) fail("fewer levels");
    if (!left()) fail("a value");
    std::uint8_t code = *at_;
    if (is_array()) {
      for (std::size_t n = array(); n; --n) skip(depth + 1);
    } else if (is_map()) {
      for (std::size_t n = 2 * map(); n; --n) skip(depth + 1);
    } else if ((code & 0xe0) == 0xa0 || (code >= 0xd9 && code <= 0xdb)) {
      text();
    } else if (code == 0xc0 || code == 0xc2 || code == 0xc3) {
      byte();
    } else if (code >= 0xc4 && code <= 0xc6) {  // bytes
      byte();
      take(big(1u << (code - 0xc4)));
    } else {
      real();
    }
  }
  template <class Field> void fields(Field&& field) {  // of a map: calls field(name), which reads the value or returns false
    for (std::size_t n = map(); n; --n)
      if (!field(text(200))) skip();
  }

 private:
  static constexpr std::int64_t LARGEST = 9007199254740992;
  std::size_t left() const { return static_cast<std::size_t>(end_ - at_); }
  const std::uint8_t* take(std::uint64_t size) {
    if (size > left()) fail("more bytes");
    at_ += size;
    return at_ - size;
  }
  std::uint8_t byte() { return *take(1); }
  std::uint64_t big(std::size_t size) {  // a big-endian number
    std::uint64_t value = 0;
    for (const std::uint8_t *p = take(size), *end = p + size; p != end; ++p) value = value << 8 | *p;
    return value;
  }
  std::size_t count(std::uint64_t items, std::size_t least_bytes) {
    if (items > left() / least_bytes) fail("more items");
    return static_cast<std::size_t>(items);
  }
  [[noreturn]] static std::uint64_t fail(const char* what) { throw BadMessage(std::string("head: expected ") + what); }
  const std::uint8_t *at_, *end_;
};

class Writer {  // keeps its memory: after some messages it allocates no more
 public:
  Writer& begin(const char* type, std::size_t fields) {  // a message that is an array
    bytes.clear();
    return array(fields + 1).text(type);
  }
  Writer& array(std::size_t n) { return n < 16 ? put(0x90 | n) : put(0xdd).big(n, 4); }
  Writer& map(std::size_t n) { return put(0x80 | n); }  // fewer than 16 pairs
  Writer& nil() { return put(0xc0); }
  Writer& boolean(bool value) { return put(value ? 0xc3 : 0xc2); }
  Writer& natural(std::uint64_t value) { return value < 128 ? put(value) : put(0xcf).big(value, 8); }
  Writer& whole(std::int64_t value) { return value >= 0 ? natural(value) : put(0xd3).big(static_cast<std::uint64_t>(value), 8); }
  Writer& real(double value) {
    std::uint64_t bits;
    std::memcpy(&bits, &value, 8);
    return put(0xcb).big(bits, 8);
  }
  Writer& text(std::string_view value) {
    value.size() < 32 ? put(0xa0 | value.size()) : put(0xdb).big(value.size(), 4);
    bytes.insert(bytes.end(), value.begin(), value.end());
    return *this;
  }
  Writer& described(std::string_view dtype, std::size_t frame, std::initializer_list<std::size_t> lead,
                                              const std::vector<std::size_t>& shape = {}) {
    array(3).text(dtype).array(lead.size() + shape.size());
    for (std::size_t side : lead) natural(side);
    for (std::size_t side : shape) natural(side);
    return natural(frame);
  }
  std::vector<std::uint8_t> bytes;

 private:
  Writer& put(std::size_t byte) { return bytes.push_back(static_cast<std::uint8_t>(byte)), *this; }
  Writer& big(std::uint64_t value, int size) {
    while (size--) put(value >> 8 * size & 0xff);
    return *this;
  }
};

}  // namespace millrace
