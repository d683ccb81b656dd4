// Prints the contacts of a running graph, the newest ones:
//
//     g++ -std=c++17 -O2 contacts.cpp -o contacts -lzmq
//     ./contacts ADDRESS OFFSET_NS      as `sparseskin topic info /skin/contacts` states them
#include <cstdio>
#include <cstdlib>

#include "sparseskin.hpp"

// Longest wait for a frame, and largest age of one that is acted on, milliseconds.
constexpr long timeout_ms = 50;
constexpr double oldest_ms = 20;

int main(int n_arguments, char** arguments) {
    if (n_arguments != 3) {
        std::fprintf(stderr, "usage: %s ADDRESS OFFSET_NS\n", arguments[0]);
        return 2;
    }
    std::setvbuf(stdout, nullptr, _IOLBF, 0);  // line by line, into a pipe too
    const std::int64_t offset_ns = std::atoll(arguments[2]);
    try {
        sparseskin::Reader<sparseskin::Contacts> reader(arguments[1], "/skin/contacts", true);
        sparseskin::Contacts contacts;
        for (;;) {
            const sparseskin::Status status = reader.next(contacts, timeout_ms);
            if (status == sparseskin::Status::ended) break;
            if (status == sparseskin::Status::timeout) {
                std::puts("no frame: hold");
                continue;
            }
            if (!contacts.trusted[0]) {
                std::puts("not trusted: hold");
                continue;
            }
            const double age_ms = 1e3 * sparseskin::age_s(contacts, offset_ns);
            if (age_ms > oldest_ms) {
                std::puts("too old: hold");
                continue;
            }
            for (const sparseskin::Contact& contact : contacts.contacts) {
                std::printf("contact %d: %.2f at (%.1f, %.1f), %.2f ms old\n", contact.id,
                            contact.total, contact.row, contact.col, age_ms);
            }
        }
        std::printf("ended; skipped: %lld\n", static_cast<long long>(reader.n_missed()));
    } catch (const sparseskin::Error& error) {
        std::fprintf(stderr, "%s\n", error.what());
        return 1;
    }
}
