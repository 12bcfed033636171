// The command line of the examples, ADDRESS [--name NAME] [--token FILE], and how they run.
#pragma once
#include <cstdlib>
#include <sstream>

#include "millrace/worker.hpp"

inline millrace::Options options_from(int count, char** words) {
  millrace::Options options;
  char host[256] = "";
  gethostname(host, sizeof host - 1);
  options.name = std::string(host) + "-" + std::to_string(getpid());
  std::string token_file = std::getenv("MILLRACE_TOKEN") ? std::getenv("MILLRACE_TOKEN") : "";
  for (int i = 1; i < count; ++i) {
    std::string word = words[i];
    if ((word == "--name" || word == "--token" || word == "--join-timeout-s") && i + 1 < count) {
      std::string value = words[++i];
      (word == "--name" ? options.name : word == "--token" ? token_file : value) = value;
      if (word == "--join-timeout-s") options.join_timeout_s = std::atof(value.c_str());
    } else if (word.compare(0, 2, "--") == 0 || !options.address.empty()) {
      throw millrace::UsageError("expected ADDRESS [--name NAME] [--token FILE] [--join-timeout-s SECONDS], got " + word);
    } else {
      options.address = word;
    }
  }
  if (options.address.empty()) throw millrace::UsageError("expected the learner's ADDRESS, such as tcp://127.0.0.1:5555");
  if (!token_file.empty()) {
    std::ifstream file(token_file);
    std::stringstream text;
    text << file.rdbuf();
    if (!file) throw millrace::UsageError("token " + token_file + ": the file cannot be read");
    options.token = text.str();
  }
  return options;
}

template <class Environment>
int run_example(int count, char** words) {  // as a worker. Returns the exit code
  try {
    std::random_device random;  // a learner that gives seeds replaces these
    millrace::drain_on_signals();
    millrace::Worker worker(options_from(count, words), Environment::description(), [&] { return std::make_unique<Environment>(random()); });
    const int code = worker.run();
    std::fprintf(stderr, "%s\n", worker.reason().c_str());
    return code;
  } catch (const millrace::UsageError& error) {
    std::fprintf(stderr, "error: %s\n", error.what());
    return 2;
  }
}
