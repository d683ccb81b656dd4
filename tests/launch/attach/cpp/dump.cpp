// Prints each message of a topic as one JSON object a line, at the end what was missed:
// dump ADDRESS TOPIC all|newest
#include <cstdio>
#include <iostream>

#include "sparseskin.hpp"

using sparseskin::Contact;
using sparseskin::Contacts;
using sparseskin::Event;
using sparseskin::Head;
using sparseskin::Reconstruction;

void put(const Contact& c);
void put(const Event& event);
void put(std::int64_t value) { std::cout << value; }
void put(std::int32_t value) { std::cout << value; }
void put(std::size_t value) { std::cout << value; }
void put(bool value) { std::cout << (value ? "true" : "false"); }

// A JSON string: control characters, quotes and bytes that may be no UTF-8 as escapes.
void put(const std::string& value) {
    std::cout << '"';
    for (const unsigned char byte : value) {
        const bool is_plain = byte >= 0x20 && byte < 0x7f && byte != '"' && byte != '\\';
        if (is_plain) {
            std::cout << byte;
        } else {
            char escaped[7];
            std::snprintf(escaped, sizeof escaped, "\\u%04x", byte);
            std::cout << escaped;
        }
    }
    std::cout << '"';
}

void put(double value) {
    char text[40];
    std::snprintf(text, sizeof text, "%.17g", value);
    std::cout << (std::isnan(value) ? "null" : text);
}

void put(float value) { put(static_cast<double>(value)); }

template <class T>
void put(const std::vector<T>& values) {
    std::cout << '[';
    for (std::size_t k = 0; k < values.size(); ++k) {
        if (k > 0) std::cout << ", ";
        put(static_cast<T>(values[k]));
    }
    std::cout << ']';
}

void put(const float (&values)[3]) { put(std::vector<float>(values, values + 3)); }

template <class T>
void field(const char* name, const T& value) {
    std::cout << ", \"" << name << "\": ";
    put(value);
}

void put(const Contact& c) {
    std::cout << "{\"id\": " << c.id;
    field("patch", c.patch);
    field("total", std::vector<float>{c.total, c.total_sd, c.peak});
    field("centre", std::vector<float>{c.row, c.col});
    field("centre_sd", std::vector<float>{c.row_sd, c.col_sd});
    field("velocity", std::vector<float>{c.row_velocity, c.col_velocity});
    field("area", c.area);
    field("age_s", c.age_s);
    field("over", c.over);
    field("sliding", c.sliding);
    field("place_mm", c.place_mm);
    field("place_sd_mm", c.place_sd_mm);
    field("velocity_mm_s", c.velocity_mm_s);
    field("normal", c.normal);
    field("area_mm2", c.area_mm2);
    std::cout << '}';
}

void put(const Event& event) {
    std::cout << '[' << event.patch << ", " << event.id << ", " << static_cast<int>(event.kind)
              << ']';
}

void head(const Head& found) {
    std::cout << "{\"stamp_ns\": " << found.stamp_ns;
    field("patch", found.patch);
    field("run_id", found.run_id);
    field("seq", found.seq);
    field("patches", found.patches);
}

void print(const Reconstruction& found) {
    head(found);
    field("shape", std::vector<std::size_t>{found.n_sent, found.n_rows, found.n_cols});
    field("forces", found.forces);
    field("sd", found.sd);
    field("phi", found.phi);
    field("done_ns", found.done_ns);
    field("skipped", found.skipped);
    field("quiet", found.quiet);
    field("iterations", found.iterations);
    field("residual", found.residual);
    field("solve_ns", found.solve_ns);
    field("error", found.error);
    field("trusted", found.trusted);
    field("unchanged", found.unchanged);
    field("reason", found.reason);
    std::cout << "}" << std::endl;
}

void print(const Contacts& found) {
    head(found);
    field("done_ns", found.done_ns);
    field("trusted", found.trusted);
    field("contacts", found.contacts);
    field("events", found.events);
    std::cout << "}" << std::endl;
}

template <class Message>
void run(char** arguments) {
    sparseskin::Reader<Message> reader(arguments[1], arguments[2],
                                       std::string(arguments[3]) == "newest");
    Message message;
    while (reader.next(message) == sparseskin::Status::message) print(message);
    std::cout << "{\"missed\": " << reader.n_missed()
              << ", \"unreadable\": " << reader.n_unreadable();
    field("why", reader.last_error());
    std::cout << "}" << std::endl;
}

int main(int, char** arguments) {
    try {
        const std::string topic = arguments[2];
        const bool is_contacts = topic.find("/contacts") != std::string::npos;
        is_contacts ? run<Contacts>(arguments) : run<Reconstruction>(arguments);
    } catch (const sparseskin::Error& error) {
        std::cerr << error.what() << std::endl;
        return 1;
    }
}
