/* The same with static objects of C++; their numbers are on the heap. */

#include <memory>

namespace {

class Workspace {
public:
    std::unique_ptr<volatile double[]> numbers = std::make_unique<volatile double[]>(2);
};

Workspace workspace; /* made when the library is loaded */

} // namespace

extern "C" void integrate_(double *x, const double *gain, const double *u, const int *steps) {
    auto &numbers = workspace.numbers;

    numbers[0] = *x;
    for (int i = 0; i < *steps; i++) {
        numbers[1] = *gain * *u - numbers[0];
        numbers[0] = numbers[0] + 0.001 * numbers[1];
    }
    *x = numbers[0];
}
