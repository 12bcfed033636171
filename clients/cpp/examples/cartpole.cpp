// CartPole in C++ as a worker of a millrace learner: cartpole ADDRESS [--name NAME] [--token FILE]
#include "cartpole.hpp"
#include "options.hpp"

int main(int count, char** words) { return run_example<CartPole>(count, words); }
