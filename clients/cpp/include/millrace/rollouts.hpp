// The tickets, weights, rollouts and evaluation orders of the collector profile, and the rows of a lane.
//
// Rule: a ticket is collected once, under the version that it names, and after those before it of its lane. Its rollout is
// kept until the learner has received it, and sent again when the learner asks for it again. The memory of a rollout that has
// arrived is used for the next one. When an order comes, we keep the weights that it lists, and those that unfinished tickets name.
#pragma once
#include <deque>

#include "policy.hpp"

namespace millrace {

struct Episode { double reward = 0; std::uint64_t length = 0; double seconds = 0; };

struct Rollout {  // T rows of N copies: in obs[t] we did action[t], got reward[t] and saw obs[t+1], wherever valid[t]
  std::uint64_t lane = 0, incarnation = 0, ticket = 0, version = 0, sequence = 0;
  std::size_t rows = 0;                                 // that are complete
  std::vector<unsigned char> obs, action;               // [T+1, C, …], [T, C, …]: C columns, one for each seat of each copy
  std::vector<float> log_prob, reward;                  // [T, C]
  std::vector<unsigned char> terminated, truncated, valid;
  std::vector<unsigned char> resets;                    // [T+1, N] of copies with seats: the step only resets the copy
  std::vector<Episode> episodes;
  std::vector<double> seat_returns;                     // [episodes, A]
};

class Rows {  // writes the rows of a lane, from one rollout to the next
 public:
  Rows(const Run& run, const Space& observation, const Space& action)
      : T(run.rollout_steps), C(run.columns()), obs_bytes(observation.bytes()), action_bytes(action.bytes()), obs(C * obs_bytes),
        floats_(observation.dtype == "float32"), doubles_(observation.dtype == "float64"), elements_(observation.elements()) {}

  void begin(Rollout& r) {
    r.rows = 0, r.episodes.clear(), r.seat_returns.clear();
    r.obs.resize((T + 1) * C * obs_bytes), r.action.resize(T * C * action_bytes);
    r.log_prob.resize(T * C), r.reward.resize(T * C), r.terminated.resize(T * C), r.truncated.resize(T * C), r.valid.resize(T * C);
    std::copy(obs.begin(), obs.end(), r.obs.begin());
  }
  void* obs_at(Rollout& r, std::size_t c) { return &r.obs[(r.rows * C + c) * obs_bytes]; }  // of the row that is not yet complete
  void* next_obs_at(Rollout& r, std::size_t c) { return &r.obs[((r.rows + 1) * C + c) * obs_bytes]; }
  void* action_at(Rollout& r, std::size_t c) { return &r.action[(r.rows * C + c) * action_bytes]; }
  float* log_prob_at(Rollout& r, std::size_t c) { return &r.log_prob[r.rows * C + c]; }
  void write(Rollout& r, std::size_t c, bool valid, double reward, bool terminated, bool truncated) {  // what came of the action
    const std::size_t i = r.rows * C + c;
    if (!std::isfinite(static_cast<float>(reward))) throw std::runtime_error("reward: expected a finite number");
    r.reward[i] = valid ? static_cast<float>(reward) : 0, r.terminated[i] = terminated, r.truncated[i] = truncated, r.valid[i] = valid;
  }
  bool end_row(Rollout& r) {  // whether the rollout is complete
    if (++r.rows < T) return false;
    std::copy(r.obs.end() - static_cast<std::ptrdiff_t>(obs.size()), r.obs.end(), obs.begin());
    return true;
  }
  void check(const void* observed) const {
    for (std::size_t i = 0; i < elements_ && (floats_ || doubles_); ++i)
      if (!std::isfinite(floats_ ? static_cast<const float*>(observed)[i] : static_cast<const double*>(observed)[i]))
        throw std::runtime_error("observation: expected finite numbers");
  }

  const std::size_t T, C, obs_bytes, action_bytes;
  std::vector<unsigned char> obs;  // [C, …] the newest observations

 private:
  bool floats_, doubles_;
  std::size_t elements_;
};

struct Permitted { std::uint64_t sequence, version; };

struct Held {  // of one lane
  std::uint64_t incarnation = 0, sequence = 0;  // sequence: of the next rollout
  std::map<std::uint64_t, Permitted> tickets;   // not yet collected
  std::vector<std::unique_ptr<Rollout>> kept;   // that the learner may not have received
};

struct Evaluation {  // an order, and its answer: an episode for each seed
  std::uint64_t ticket, version, most_steps;
  bool greedy;
  std::vector<std::uint64_t> seeds;
  std::vector<Episode> episodes;
  std::vector<double> seat_returns;  // [episodes, A]
  std::vector<bool> cut;
};

class CollectorSession : public Session {  // a Session that holds the weights and what belongs to tickets
 public:
  using Session::Session;

 protected:
  std::string other_spaces(const Run& run) const {  // why these are not our spaces, or nothing
    bool same = run.observation.size() == 1 && run.action.size() == 1 && description_.observation.is(run.observation[0]) &&
                description_.action.is(run.action[0]);
    if (!same) return "environment " + description_.id + ": its observations or actions are not what the learner has; build both from the same version";
    if (run.seats == description_.seats && (run.takes_turns || !description_.takes_turns)) return "";  // who may wait need not
    auto named = [](const std::vector<std::string>& seats, bool takes_turns) {
      std::string all;
      for (const std::string& seat : seats) all += (all.empty() ? " " : ", ") + seat;
      return (takes_turns ? "agents that take turns:" : "agents:") + (all.empty() ? " none" : all);
    };
    return "environment " + description_.id + ": expected " + named(run.seats, run.takes_turns) + ", this client has " + named(description_.seats, description_.takes_turns);
  }
  virtual std::string no_rows() const { return "the C++ client does not record episodes by itself; add --inference learner"; }
  std::string begin_collecting(const Run& run) {
    const Space &seen = description_.observation, &done = description_.action;
    if (std::string why = other_spaces(run); !why.empty()) return why;
    if (run.rollout_steps + 1 > MAX_FRAME_BYTES / run.columns() / std::max(seen.bytes(), done.bytes())) return "the learner asks for rollouts of more than 1 GB";
    if (seen.dtype == "uint8" && seen.shape.size() == 3) return "the C++ client has no convolutions; start the learner with --inference learner";
    if (done.kind == "box" && done.dtype != "float32") return "the C++ client chooses float32 actions; start the learner with --inference learner";
    policy_ = Policy(run, seen, done);
    loaded_.reset();
    return "";
  }
  void end_collecting() { held_.clear(), weights_.clear(), orders_.clear(), answers_.clear(); }

  void handle_collecting(const Message& m) {
    switch (m.type) {
      case Type::Weights: return take_weights(m);
      case Type::Collect:
        received(m);
        for (const Permit& permit : m.permits) take(permit, m.version);
        return keep_weights(m);
      case Type::HeartbeatReply: return received(m);
      case Type::Evaluate: return take_evaluation(m), keep_weights(m);
      default: return;
    }
  }
  const std::vector<std::uint64_t>& tickets() override {
    listed_.clear();
    for (auto& [number, lane] : held_) for (auto& [ticket, permitted] : lane.tickets) listed_.push_back(ticket);
    for (const Evaluation& order : orders_) listed_.push_back(order.ticket);
    return listed_;
  }
  const std::vector<std::uint64_t>& versions() override {
    listed_versions_.clear();
    for (auto& [version, weights] : weights_) listed_versions_.push_back(version);
    return listed_versions_;
  }
  std::vector<std::uint64_t> lanes() const override {
    std::vector<std::uint64_t> all;
    for (auto& [number, lane] : held_) all.push_back(number);
    return all;
  }
  void release(std::uint64_t number, std::uint64_t incarnation) override {
    auto found = held_.find(number);
    if (found != held_.end() && found->second.incarnation <= incarnation) held_.erase(found);
  }

  bool acts() const { return loaded_.has_value(); }  // whether weights have come, under which the policy can act
  void load_newest() {
    if (!weights_.empty()) load(weights_.rbegin()->first);
  }
  std::unique_ptr<Rollout> next_rollout() {  // of those that can start: the lowest version, then the oldest ticket. Or null
    const std::uint64_t none = std::numeric_limits<std::uint64_t>::max();
    std::array<std::uint64_t, 3> first{none, none, none};
    for (auto& [number, held] : held_)
      for (auto& [ticket, permitted] : held.tickets)
        if (permitted.sequence == held.sequence && weights_.count(permitted.version))
          first = std::min(first, {permitted.version, ticket, number});
    const auto [version, ticket, number] = first;
    if (ticket == none) return nullptr;
    load(version);
    std::unique_ptr<Rollout> rollout = spare_.empty() ? std::make_unique<Rollout>() : std::move(spare_.back());
    if (!spare_.empty()) spare_.pop_back();
    const Held& held = held_[number];
    rollout->lane = number, rollout->incarnation = held.incarnation, rollout->ticket = ticket, rollout->sequence = held.sequence;
    rollout->version = version;
    return rollout;
  }
  bool wanted(const Rollout& r, std::uint64_t session) const {  // whether its ticket still is ours
    auto found = held_.find(r.lane);
    return session == session_ && (state_ == State::ready || state_ == State::draining) && found != held_.end() &&
           found->second.incarnation == r.incarnation && found->second.tickets.count(r.ticket);
  }
  void finished(std::unique_ptr<Rollout> rollout) {
    if (run_.seats.empty()) for (unsigned char valid : rollout->valid) steps_ += valid;
    else for (std::size_t i = 0; i < run_.rollout_steps * run_.copies; ++i) steps_ += !rollout->resets[i];
    Held& held = held_[rollout->lane];
    held.tickets.erase(rollout->ticket), ++held.sequence;
    send_rollout(*rollout);
    held.kept.push_back(std::move(rollout));
  }
  const Evaluation* next_evaluation() {  // the oldest order whose weights are held
    for (const Evaluation& order : orders_)
      if (weights_.count(order.version)) return load(order.version), &order;
    return nullptr;
  }
  void evaluated(const Evaluation& evaluation) {
    auto same = [&](const Evaluation& order) { return order.ticket == evaluation.ticket; };
    auto found = std::find_if(orders_.begin(), orders_.end(), same);
    if (found == orders_.end()) return;
    orders_.erase(found);
    answers_.push_back(evaluation);
    if (answers_.size() > 8) answers_.pop_front();
    send_evaluation(evaluation);
  }

  Policy policy_;

 private:
  void take_weights(const Message& m) {
    if (m.arrays.size() > 2) return decline("the C++ client has no attributes that the learner could set in its environments");
    if (!weights_.count(m.version)) weights_.emplace(m.version, policy_.weights(m));  // a rollout in progress goes on under its own
  }
  void load(std::uint64_t version) {  // let the policy act under these weights, which are held
    if (loaded_ != version) policy_.load(weights_.at(version)), loaded_ = version;
  }
  void keep_weights(const Message& m) {  // those that this order lists, and those that are asked for
    auto kept = [&](std::uint64_t version) {
      for (auto& [number, lane] : held_) for (auto& [ticket, permitted] : lane.tickets) if (permitted.version == version) return true;
      for (const Evaluation& order : orders_) if (order.version == version) return true;
      return std::find(m.keep.begin(), m.keep.end(), version) != m.keep.end();
    };
    for (auto each = weights_.begin(); each != weights_.end();) each = kept(each->first) ? std::next(each) : weights_.erase(each);
  }
  void take(const Permit& permit, std::uint64_t version) {
    auto found = held_.find(permit.lane);
    if (found == held_.end() || permit.incarnation > found->second.incarnation) {
      Held fresh;
      fresh.incarnation = permit.incarnation;
      held_[permit.lane] = std::move(fresh);
    }
    Held& held = held_[permit.lane];
    if (permit.incarnation < held.incarnation) return;
    for (const auto& rollout : held.kept) if (rollout->ticket == permit.ticket) return send_rollout(*rollout);
    if (permit.sequence >= held.sequence) held.tickets.emplace(permit.ticket, Permitted{permit.sequence, version});  // else a late copy
  }
  void received(const Message& m) {
    for (const Received& got : m.received) {
      auto found = held_.find(got.lane);
      if (found == held_.end() || found->second.incarnation != got.incarnation) continue;
      Held& held = found->second;
      auto first = m.numbers.begin() + static_cast<std::ptrdiff_t>(got.first), last = first + static_cast<std::ptrdiff_t>(got.count);
      for (std::size_t i = held.kept.size(); i-- > 0;) {
        const std::uint64_t sequence = held.kept[i]->sequence;
        if (sequence >= got.next_sequence && std::find(first, last, sequence) == last) continue;
        spare_.push_back(std::move(held.kept[i]));
        held.kept.erase(held.kept.begin() + static_cast<std::ptrdiff_t>(i));
      }
    }
  }
  void take_evaluation(const Message& m) {
    if (m.send_rows) return decline(no_rows());
    for (const Evaluation& answer : answers_) if (answer.ticket == m.ticket) return send_evaluation(answer);
    for (const Evaluation& order : orders_) if (order.ticket == m.ticket || (order.ticket > m.ticket && order.version != m.version)) return;
    auto over = [&](const Evaluation& order) { return order.version != m.version; };  // the order of a later evaluation ends those before it
    orders_.erase(std::remove_if(orders_.begin(), orders_.end(), over), orders_.end());
    orders_.push_back({m.ticket, m.version, m.most_steps, m.greedy, {}, {}, {}, {}});
    for (auto& seed : m.seeds) orders_.back().seeds.push_back(*seed);
  }

  void write(const std::vector<Episode>& episodes, const std::vector<double>& seat_returns) {
    const std::size_t A = run_.seats.size(), K = run_.info_keys.size(), reported = K + A <= MAX_FACTS ? A : 0;
    head_.array(episodes.size());
    for (std::size_t i = 0; i < episodes.size(); ++i) {
      head_.array(4).real(episodes[i].reward).natural(episodes[i].length).real(std::max(0.0, episodes[i].seconds)).array(K + reported);
      for (std::size_t k = 0; k < K; ++k) head_.real(std::nan(""));  // facts that the learner asks for: we have none
      for (std::size_t a = 0; a < reported; ++a) head_.real(seat_returns[i * A + a]);
    }
  }
  void send_rollout(const Rollout& r) {
    const std::size_t T = run_.rollout_steps, C = run_.columns(), N = run_.copies;
    const Space &seen = description_.observation, &done = description_.action;
    const bool seats = !run_.seats.empty();
    head_.begin("Rollout", seats ? 17 : 14).natural(session_).natural(r.lane).natural(r.ticket).natural(r.version).natural(r.sequence);
    head_.array(1).described(seen.wire(), 1, {T + 1, C}, seen.shape);
    head_.described(done.kind == "discrete" ? "<i8" : "<f4", 2, {T, C}, done.shape);
    head_.described("<f4", 3, {T, C}).described("<f4", 4, {T, C}).described("|b1", 5, {T, C}).described("|b1", 6, {T, C});
    head_.described("|b1", 7, {T, C}).described("<f4", 8, {C, 0});
    write(r.episodes, r.seat_returns);
    if (seats) head_.nil().array(0).described("|b1", 9, {T + 1, N});
    const std::array<Frame, 9> frames{{{r.obs.data(), r.obs.size()}, {r.action.data(), r.action.size()}, {r.log_prob.data(), 4 * T * C},
                                       {r.reward.data(), 4 * T * C}, {r.terminated.data(), T * C}, {r.truncated.data(), T * C},
                                       {r.valid.data(), T * C}, {nullptr, 0}, {r.resets.data(), (T + 1) * N}}};
    send(head_, frames.data(), seats ? 9 : 8);
  }
  void send_evaluation(const Evaluation& e) {
    head_.begin("Evaluated", 4).natural(session_).natural(e.ticket);
    write(e.episodes, e.seat_returns);
    head_.array(e.cut.size());
    for (bool cut : e.cut) head_.boolean(cut);
    send(head_);
  }

  std::map<std::uint64_t, Weights> weights_;  // by version
  std::optional<std::uint64_t> loaded_;       // the version under which the policy acts
  std::map<std::uint64_t, Held> held_;
  std::vector<std::unique_ptr<Rollout>> spare_;
  std::vector<Evaluation> orders_;
  std::deque<Evaluation> answers_;
  std::vector<std::uint64_t> listed_, listed_versions_;
};

}  // namespace millrace
