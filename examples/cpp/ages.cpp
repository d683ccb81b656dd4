// Prints the age of some contact messages, the newest each time:
//
//     g++ -std=c++17 -O2 ages.cpp -o ages -lzmq
//     ./ages ADDRESS OFFSET_NS N_MESSAGES
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <vector>

#include "sparseskin.hpp"

int main(int n_arguments, char** arguments) {
    if (n_arguments != 4) {
        std::fprintf(stderr, "usage: %s ADDRESS OFFSET_NS N_MESSAGES\n", arguments[0]);
        return 2;
    }
    const std::int64_t offset_ns = std::atoll(arguments[2]);
    const std::size_t n_messages = std::strtoul(arguments[3], nullptr, 10);
    std::vector<double> ages_ms;
    try {
        sparseskin::Reader<sparseskin::Contacts> reader(arguments[1], "/skin/contacts", true);
        sparseskin::Contacts contacts;
        while (ages_ms.size() < n_messages) {
            const sparseskin::Status status = reader.next(contacts, 100);
            if (status == sparseskin::Status::ended) break;
            if (status == sparseskin::Status::timeout) continue;
            ages_ms.push_back(1e3 * sparseskin::age_s(contacts, offset_ns));
        }
    } catch (const sparseskin::Error& error) {
        std::fprintf(stderr, "%s\n", error.what());
        return 1;
    }
    for (const double age_ms : ages_ms) std::printf("%.4f\n", age_ms);
}
