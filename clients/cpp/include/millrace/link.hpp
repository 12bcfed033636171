// A client's end of its connection: one DEALER socket, with the token if there is one.
//
// Rule: sending never blocks and never fails; what is lost, the conversation repairs. libzmq connects again by itself.
#pragma once
#include <sodium.h>
#include <zmq.h>

#include <cerrno>

#include "messages.hpp"

namespace millrace {

struct UsageError : std::runtime_error {  // one line for the person who started the client; exit code 2
  using std::runtime_error::runtime_error;
};

struct Token {  // a join token of `millrace keys new`: whom to trust, and who we are
  unsigned char server[32], secret[32], key[32];  // the learner's public key; our key pair

  static Token read(std::string text) {
    static const std::string prefix = "millrace1.";
    while (!text.empty() && std::isspace(static_cast<unsigned char>(text.back()))) text.pop_back();
    unsigned char body[68], hash[crypto_hash_sha256_BYTES];
    std::size_t size = 0;
    crypto_hash_sha256_state state;
    if (sodium_init() < 0) throw UsageError("libsodium cannot be used on this machine");
    if (text.compare(0, prefix.size(), prefix) != 0)
      throw UsageError("token: expected one line that begins with millrace1., got something else");
    if (sodium_base642bin(body, 68, text.data() + prefix.size(), text.size() - prefix.size(), nullptr, &size, nullptr,
                          sodium_base64_VARIANT_URLSAFE_NO_PADDING) != 0 || size != 68)
      throw UsageError("token: expected 101 characters of a join token, got " + std::to_string(text.size()) + "; copy it again");
    crypto_hash_sha256_init(&state);
    crypto_hash_sha256_update(&state, reinterpret_cast<const unsigned char*>(prefix.data()), prefix.size());
    crypto_hash_sha256_update(&state, body, 64);
    crypto_hash_sha256_final(&state, hash);
    if (std::memcmp(hash, body + 64, 4) != 0) throw UsageError("token: a character of it is wrong; copy it again");
    Token token;
    std::memcpy(token.server, body, 32), std::memcpy(token.secret, body + 32, 32);
    crypto_scalarmult_base(token.key, token.secret);
    return token;
  }
};

class Link {
 public:
  Link(const std::string& address, const std::string& name, const std::optional<Token>& token) : address_(address) {
    if (name.empty() || name.size() > 200) throw UsageError("name: expected 1 to 200 bytes, got " + std::to_string(name.size()));
    context_ = zmq_ctx_new();
    socket_ = zmq_socket(context_, ZMQ_DEALER);
    std::string id = name;
    if (token) {
      unsigned char tag[16];
      char hex[33];
      crypto_generichash(tag, 16, reinterpret_cast<const unsigned char*>(name.data()), name.size(), token->secret, 32);
      id += std::string(1, '\0') + sodium_bin2hex(hex, 33, tag, 16);
      set(ZMQ_CURVE_SERVERKEY, token->server, 32), set(ZMQ_CURVE_PUBLICKEY, token->key, 32);
      set(ZMQ_CURVE_SECRETKEY, token->secret, 32);
    }
    set(ZMQ_ROUTING_ID, id.data(), id.size());
    for (auto [option, value] : {std::pair{ZMQ_LINGER, 2000}, {ZMQ_HANDSHAKE_IVL, 2000}, {ZMQ_CONNECT_TIMEOUT, 2000},
                                 {ZMQ_TCP_MAXRT, 5000}, {ZMQ_TCP_KEEPALIVE, 1}, {ZMQ_TCP_KEEPALIVE_IDLE, 15},
                                 {ZMQ_TCP_KEEPALIVE_INTVL, 5}, {ZMQ_TCP_KEEPALIVE_CNT, 3}, {ZMQ_RECONNECT_IVL, 100},
                                 {ZMQ_RECONNECT_IVL_MAX, 2000}, {ZMQ_IPV6, address.find('[') != std::string::npos}})
      set(option, &value, sizeof value);
    std::int64_t largest = MAX_FRAME_BYTES + (token ? 33 : 0);
    set(ZMQ_MAXMSGSIZE, &largest, sizeof largest);
    const char* events = "inproc://millrace-events";
    zmq_socket_monitor(socket_, events, ZMQ_EVENT_HANDSHAKE_FAILED_NO_DETAIL | ZMQ_EVENT_HANDSHAKE_FAILED_PROTOCOL |
                                            ZMQ_EVENT_HANDSHAKE_FAILED_AUTH | ZMQ_EVENT_HANDSHAKE_SUCCEEDED);
    monitor_ = zmq_socket(context_, ZMQ_PAIR);
    int unlimited = 0;  // libzmq blocks while nobody reads its events, and a step of an environment may take minutes
    zmq_setsockopt(monitor_, ZMQ_RCVHWM, &unlimited, sizeof unlimited);
    zmq_connect(monitor_, events);
    if (zmq_connect(socket_, address.c_str()) != 0) {
      std::string why = zmq_strerror(errno);
      close();
      throw UsageError("address " + address + ": expected tcp://HOST:PORT or ipc://PATH, got what libzmq cannot use: " + why);
    }
  }
  ~Link() { close(); }
  Link(const Link&) = delete;

  void send(const Writer& head, const Frame* arrays = nullptr, std::size_t left = 0) {
    if (zmq_send(socket_, head.bytes.data(), head.bytes.size(), ZMQ_DONTWAIT | (left ? ZMQ_SNDMORE : 0)) < 0) return;
    for (; left; ++arrays) zmq_send(socket_, arrays->data, arrays->size, ZMQ_DONTWAIT | (--left ? ZMQ_SNDMORE : 0));
  }
  bool wait(double seconds) {  // until something arrived; also ends at a signal
    zmq_pollitem_t items[] = {{socket_, 0, ZMQ_POLLIN, 0}, {monitor_, 0, ZMQ_POLLIN, 0}};
    zmq_poll(items, 2, static_cast<long>(std::ceil(std::max(0.0, seconds) * 1000)));
    if (items[1].revents) read_events();
    return items[0].revents != 0;
  }
  const std::vector<Frame>* receive() {  // the frames of the next message, until the next call; null if there is none
    close_frames();
    frames_.clear();
    do {
      if (parts_.size() == frames_.size()) parts_.emplace_back(std::make_unique<zmq_msg_t>());
      zmq_msg_t* part = parts_[frames_.size()].get();
      zmq_msg_init(part);
      if (zmq_msg_recv(part, socket_, ZMQ_DONTWAIT) < 0) return zmq_msg_close(part), frames_.clear(), nullptr;
      frames_.push_back({zmq_msg_data(part), zmq_msg_size(part)});
    } while (zmq_msg_more(parts_[frames_.size() - 1].get()));
    return &frames_;
  }
  void connect_again() { zmq_disconnect(socket_, address_.c_str()), zmq_connect(socket_, address_.c_str()); }

  std::string problem;   // why there is no connection, if that is known
  bool refused = false;  // the learner refused our key: a retry cannot help

 private:
  void set(int option, const void* value, std::size_t size) { zmq_setsockopt(socket_, option, value, size); }
  void read_events() {
    zmq_msg_t part;
    zmq_msg_init(&part);
    while (zmq_msg_recv(&part, monitor_, ZMQ_DONTWAIT) >= 6) {
      std::uint16_t event;
      std::uint32_t value;
      std::memcpy(&event, zmq_msg_data(&part), 2);
      std::memcpy(&value, static_cast<char*>(zmq_msg_data(&part)) + 2, 4);
      while (zmq_msg_more(&part)) zmq_msg_recv(&part, monitor_, 0);  // the endpoint
      refused = event == ZMQ_EVENT_HANDSHAKE_FAILED_AUTH && value == 400;
      if (event == ZMQ_EVENT_HANDSHAKE_SUCCEEDED) problem.clear();
      else if (refused) problem = "the learner at " + address_ + " refused this client's key: not allowed there, or revoked";
      else problem = address_ + " breaks off the handshake; perhaps it asks for a token, or this token is of another learner";
      if (refused) break;
    }
    zmq_msg_close(&part);
  }
  void close_frames() {
    for (std::size_t i = 0; i < frames_.size(); ++i) zmq_msg_close(parts_[i].get());
    frames_.clear();
  }
  void close() {
    close_frames();
    zmq_socket_monitor(socket_, nullptr, 0);
    zmq_close(monitor_), zmq_close(socket_), zmq_ctx_term(context_);
  }
  std::string address_;
  void *context_, *socket_, *monitor_ = nullptr;
  std::vector<std::unique_ptr<zmq_msg_t>> parts_;  // their memory is used again
  std::vector<Frame> frames_;
};

}  // namespace millrace
