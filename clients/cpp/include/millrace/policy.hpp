// The policy in the client (collector profile): an MLP from the flat weights, its distribution, and what it draws.
//
// Rule: everything is float32. Sums go from the first input to the last, and nothing is fused (-ffp-contract=off), so the
// same weights, observations and random numbers give the same bits on every processor with the same libm.
#pragma once
#include "session.hpp"

namespace millrace {

class Random {  // SplitMix64 (Steele et al. 2014); normal numbers by Box and Muller
 public:
  Random(std::initializer_list<std::uint64_t> seed = {}) {
    for (std::uint64_t each : seed) state_ = bits() ^ each;
  }
  std::uint64_t bits() {
    std::uint64_t z = state_ += 0x9e3779b97f4a7c15;
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9;
    z = (z ^ z >> 27) * 0x94d049bb133111eb;
    return z ^ z >> 31;
  }
  float uniform() { return (static_cast<float>(bits() >> 40) + 0.5f) * 0x1p-24f; }  // in (0, 1)
  float gumbel() { return -std::log(-std::log(uniform())); }
  float normal() { float radius = std::sqrt(-2 * std::log(uniform())); return radius * std::cos(6.2831853f * uniform()); }

 private:
  std::uint64_t state_ = 0;
};

struct Weights { std::vector<float> parameters, buffers; };  // in the order of the wire document

class Policy {
 public:
  Policy() = default;
  Policy(const Run& run, const Space& observation, const Space& action)
      : observation_(observation), action_(action), relu_(run.relu), normalize_(run.normalize), scale_(1.0f / static_cast<float>(observation.divisor())),
        inputs_(observation.kind == "discrete" ? static_cast<std::size_t>(observation.n) : observation.elements()),
        outputs_(action.kind == "discrete" ? static_cast<std::size_t>(action.n) : action.elements()) {
    std::size_t width = inputs_, widest = std::max(inputs_, outputs_);
    for (std::size_t next : run.net) {
      if (!next || next > 1 << 16) throw BadMessage("PolicySpec: expected widths from 1 to 65536");
      layers_.push_back({width, next, {}, {}}), width = next, widest = std::max(widest, next);
    }
    layers_.push_back({width, outputs_, {}, {}});
    x_.resize(widest), y_.resize(widest), params_.resize(outputs_), log_std_.resize(action.kind == "box" ? outputs_ : 0);
    size_ = log_std_.size();
    for (const Layer& layer : layers_) size_ += layer.outputs * (layer.inputs + 1);
  }

  Weights weights(const Message& m) const {  // throws BadMessage if they are not of this policy
    const Array &given = m.arrays[0], &buffers = m.arrays[1];
    bool known = given.dtype == "<f4" || given.dtype == "<u2";
    if (!known || given.elements != size_ || buffers.elements != (normalize_ ? 2 * inputs_ : 0))
      throw BadMessage("Weights: expected " + std::to_string(size_) + " parameters, got " + std::to_string(given.elements));
    const float* numbers = static_cast<const float*>(buffers.data);
    Weights taken{std::vector<float>(size_), {numbers, numbers + buffers.elements}};
    for (std::size_t i = 0; i < size_; ++i) taken.parameters[i] = as_float(given, i);
    return taken;
  }
  void load(const Weights& weights) {  // act under these
    const float* next = weights.parameters.data();
    for (Layer& layer : layers_) {
      layer.weight.resize(layer.inputs * layer.outputs), layer.bias.resize(layer.outputs);
      for (std::size_t o = 0; o < layer.outputs; ++o)
        for (std::size_t i = 0; i < layer.inputs; ++i) layer.weight[i * layer.outputs + o] = *next++;  // [out, in] -> [in, out]
      for (float& each : layer.bias) each = *next++;
    }
    for (float& each : log_std_) each = *next++;
    buffers_ = weights.buffers;
  }

  void act(const void* obs, Random* random, void* action, float* log_prob) {  // without random numbers: the most probable action
    forward(obs);
    if (action_.kind == "discrete") {
      std::size_t best = 0;
      float highest = -std::numeric_limits<float>::infinity(), largest = highest, sum = 0;
      for (std::size_t i = 0; i < outputs_; ++i) {
        float value = params_[i] + (random ? random->gumbel() : 0);
        if (value > highest) highest = value, best = i;
        largest = std::max(largest, params_[i]);
      }
      for (float logit : params_) sum += std::exp(logit - largest);
      *log_prob = params_[best] - largest - std::log(sum);
      std::int64_t chosen = static_cast<std::int64_t>(best);
      std::memcpy(action, &chosen, 8);  // counted from 0
    } else {
      float* drawn = static_cast<float*>(action);
      *log_prob = 0;
      for (std::size_t i = 0; i < outputs_; ++i) {
        drawn[i] = params_[i] + (random ? std::exp(log_std_[i]) * random->normal() : 0);
        float z = (drawn[i] - params_[i]) * std::exp(-log_std_[i]);
        *log_prob += -0.5f * z * z - log_std_[i] - 0.918938533f;
      }
    }
  }

  void to_env(const void* stored, void* action) const {  // shifted by the start of a Discrete, clipped to the bounds of a Box
    if (action_.kind == "discrete") {
      std::int64_t chosen;
      std::memcpy(&chosen, stored, 8), chosen += action_.start;
      std::memcpy(action, &chosen, 8);
    } else {
      for (std::size_t i = 0; i < outputs_; ++i) {
        auto bound = [&](const std::vector<double>& all) { return static_cast<float>(all[all.size() == 1 ? 0 : i]); };
        static_cast<float*>(action)[i] = std::min(std::max(static_cast<const float*>(stored)[i], bound(action_.low)), bound(action_.high));
      }
    }
  }

 private:
  struct Layer { std::size_t inputs, outputs; std::vector<float> weight, bias; };

  void forward(const void* obs) {
    for (std::size_t i = 0; i < inputs_; ++i) x_[i] = feature(obs, i);
    for (const Layer& layer : layers_) {
      bool last = &layer == &layers_.back();
      float* y = last ? params_.data() : y_.data();
      std::fill(y, y + layer.outputs, 0.0f);
      for (std::size_t i = 0; i < layer.inputs; ++i) {
        const float* row = &layer.weight[i * layer.outputs];
        for (std::size_t o = 0; o < layer.outputs; ++o) y[o] += x_[i] * row[o];
      }
      for (std::size_t o = 0; o < layer.outputs; ++o) y[o] += layer.bias[o];
      if (last) return;
      for (std::size_t o = 0; o < layer.outputs; ++o) y[o] = relu_ ? std::max(y[o], 0.0f) : std::tanh(y[o]);
      x_.swap(y_);
    }
  }
  float feature(const void* obs, std::size_t i) const {
    if (observation_.kind == "discrete") {
      std::int64_t value;
      std::memcpy(&value, obs, 8);
      return value - observation_.start == static_cast<std::int64_t>(i);
    }
    double value = observation_.dtype == "float32"   ? static_cast<const float*>(obs)[i]
                   : observation_.dtype == "float64" ? static_cast<const double*>(obs)[i]
                   : observation_.dtype == "uint8"   ? static_cast<const unsigned char*>(obs)[i] * scale_
                                                     : static_cast<double>(static_cast<const std::int64_t*>(obs)[i]);
    if (!normalize_) return static_cast<float>(value);
    double mean = buffers_[i], std = buffers_[inputs_ + i];
    bool wide = observation_.dtype == "float64" || observation_.dtype == "int64";  // float32 may not tell its numbers apart
    double scaled = wide ? (value - mean) / std : (static_cast<float>(value) - buffers_[i]) / buffers_[inputs_ + i];
    return static_cast<float>(std::min(std::max(scaled, -10.0), 10.0));
  }
  static float as_float(const Array& array, std::size_t i) {  // float32, or bfloat16 sent as uint16
    float value;
    if (array.dtype == "<f4") return std::memcpy(&value, static_cast<const char*>(array.data) + 4 * i, 4), value;
    std::uint16_t half;
    std::memcpy(&half, static_cast<const char*>(array.data) + 2 * i, 2);
    std::uint32_t bits = std::uint32_t(half) << 16;
    return std::memcpy(&value, &bits, 4), value;
  }

  Space observation_, action_;
  bool relu_ = false, normalize_ = false;
  float scale_ = 1;  // of bytes
  std::size_t inputs_ = 0, outputs_ = 0, size_ = 0;
  std::vector<Layer> layers_;
  std::vector<float> x_, y_, params_, log_std_, buffers_;
};

}  // namespace millrace
