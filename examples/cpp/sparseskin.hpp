// Reads reconstructions and contacts of a running sparseskin graph: ZeroMQ and the C++ library alone.
//
//     sparseskin::Reader<sparseskin::Contacts> reader(address, "/skin/contacts", true);
//     sparseskin::Contacts contacts;
//     while (reader.next(contacts, 50) != sparseskin::Status::ended) { ... }
//
// C++17; link with -lzmq. The address is that of `sparseskin topic info /skin/contacts`. Graphs with
// keys are not read. A message is a topic, a zero byte and a map of msgpack, as messages/wire.py of
// sparseskin has it; one of another version is refused with an error that names both.
#ifndef SPARSESKIN_HPP
#define SPARSESKIN_HPP

#include <zmq.h>

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <map>
#include <stdexcept>
#include <string>
#include <time.h>
#include <utility>
#include <vector>

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "arrays are little-endian");

namespace sparseskin {

// A message that is malformed or of another version, or a socket that fails.
struct Error : std::runtime_error {
    using std::runtime_error::runtime_error;
};

// What all messages have. `stamp_ns`: time of the acquisition of the frame on the graph's clock,
// nanoseconds. `seq`: 0, 1, 2, ... of a publisher run and topic. `patches`: names of the patches, in
// the order of the arrays.
struct Head {
    std::string patch;
    std::string run_id;
    std::vector<std::string> patches;
    std::int64_t stamp_ns = 0;
    std::int64_t seq = 0;
};

// Forces of a frame; vectors have an entry for each patch.
struct Reconstruction : Head {
    // Forces in the unit of the skin, 0 or more: patch after patch, row after row. Patches that are
    // `unchanged` may be left out, all of them: `n_sent` are there.
    std::vector<float> forces;
    std::size_t n_sent = 0;
    std::size_t n_rows = 0;
    std::size_t n_cols = 0;
    std::vector<float> sd;  // standard deviation of each force, as `forces`; empty: not computed
    std::string phi;        // fingerprint of the measurement matrix
    std::int64_t done_ns = 0;  // time of the reconstruction on the graph's clock, nanoseconds
    std::int64_t skipped = 0;  // frames that the reconstructor skipped before this one
    std::int64_t quiet = 0;    // frames so far that were not sent, as nothing had changed
    std::vector<std::int64_t> iterations;
    std::vector<double> residual;
    std::vector<std::int64_t> solve_ns;
    std::vector<double> error;  // RMS error of a taxel, in the unit of the skin; NaN: not known
    std::vector<bool> trusted;  // false: do not act on the forces, as `reason` states
    std::vector<bool> unchanged;
    std::vector<std::string> reason;
};

// One contact. What is not known is NaN. Places of a flat skin are mm along columns and rows.
struct Contact {
    std::int32_t id = 0;  // kept from frame to frame, from 1 on
    std::size_t patch = 0;  // index in `patches`
    float total = 0, total_sd = 0, peak = 0;  // sum of the forces, its deviation, largest force
    float row = 0, col = 0, row_sd = 0, col_sd = 0;  // centre of pressure, in taxels
    float row_velocity = 0, col_velocity = 0;        // taxels per second
    std::int32_t area = 0;                           // number of taxels
    float age_s = 0;
    bool over = false, sliding = false;
    float place_mm[3] = {NAN, NAN, NAN};
    float place_sd_mm[3] = {NAN, NAN, NAN};
    float velocity_mm_s[3] = {NAN, NAN, NAN};
    float normal[3] = {NAN, NAN, NAN};
    float area_mm2 = NAN;
};

enum class EventKind { begin, end, over, slide, touch };

// What changed in a frame.
struct Event {
    std::size_t patch = 0;
    std::int32_t id = 0;
    EventKind kind = EventKind::begin;
};

struct Contacts : Head {
    std::vector<Contact> contacts;
    std::vector<Event> events;
    std::int64_t done_ns = 0;
    std::vector<bool> trusted;  // as of the reconstruction, of each patch
};

// Time from the acquisition of a frame until now, seconds, on the host of the graph. The offset is
// `clock_offset_ns` of `sparseskin topic info --json`.
inline double age_s(const Head& head, std::int64_t clock_offset_ns) {
    timespec now{};
    clock_gettime(CLOCK_MONOTONIC, &now);
    const std::int64_t now_ns = std::int64_t{now.tv_sec} * 1000000000 + now.tv_nsec;
    return static_cast<double>(now_ns + clock_offset_ns - head.stamp_ns) / 1e9;
}

namespace detail {

constexpr std::size_t max_message = 8 * (std::size_t{1} << 20) + 65536;
// Messages that wait at most: 1000 on each side (ZMQ_SNDHWM, ZMQ_RCVHWM).
constexpr int max_waiting = 2000;
constexpr std::size_t max_elements = std::size_t{1} << 20;
// Values of msgpack in a message: 256 patches have some 1600. Each takes a hundred times its bytes.
constexpr std::size_t max_values = 8192;
// A part of a message that is read from its begin; it never reads beyond the end.
class Bytes {
public:
    Bytes(const unsigned char* data, std::size_t size) : data_(data), size_(size) {}

    std::size_t left() const { return size_ - at_; }

    const unsigned char* take(std::size_t n) {
        if (n > left()) throw Error("message cut off");
        const unsigned char* begin = data_ + at_;
        at_ += n;
        return begin;
    }

    template <class T>
    T take() {
        T value;
        std::memcpy(&value, take(sizeof(T)), sizeof(T));
        return value;
    }

    // Unsigned number of n bytes, the highest byte first, as msgpack has them.
    std::uint64_t big_endian(std::size_t n) {
        std::uint64_t value = 0;
        for (const unsigned char* byte = take(n); n > 0; --n) value = value << 8 | *byte++;
        return value;
    }

    void count_value() {
        if (++n_values_ > max_values) throw Error("message: too many values");
    }

private:
    const unsigned char* data_;
    std::size_t size_;
    std::size_t at_ = 0;
    std::size_t n_values_ = 0;
};

// A value of msgpack. The bytes of texts and binary fields are those of the message.
struct Value {
    enum class Kind { nothing, whole, real, text, list, map };

    Kind kind = Kind::nothing;
    std::int64_t whole = 0;
    double real = NAN;
    const unsigned char* data = nullptr;
    std::size_t size = 0;
    std::vector<Value> list;
    std::map<std::string, Value> map;

    // The value of a key; nothing where there is none: sparseskin leaves out what is as ever.
    const Value& operator[](const std::string& key) const {
        static const Value missing;
        const auto entry = map.find(key);
        return entry == map.end() ? missing : entry->second;
    }

    bool is_missing() const { return kind == Kind::nothing; }

    std::int64_t as_whole(const char* name) const {
        if (kind != Kind::whole) throw Error(std::string(name) + ": expected a whole number");
        return whole;
    }

    // NaN where a number is not known.
    double as_real(const char* name) const {
        if (kind == Kind::whole) return static_cast<double>(whole);
        if (kind != Kind::real && !is_missing()) {
            throw Error(std::string(name) + ": expected a number");
        }
        return real;
    }

    std::string as_text(const char* name) const {
        if (kind != Kind::text) throw Error(std::string(name) + ": expected a text");
        return std::string(data, data + size);
    }
};

inline Value unpack(Bytes& bytes, int depth = 8);

inline Value unpack_text(Bytes& bytes, std::size_t n) {
    Value value;
    value.kind = Value::Kind::text;
    value.data = bytes.take(n);
    value.size = n;
    return value;
}

inline Value unpack_whole(std::int64_t whole) {
    Value value;
    value.kind = Value::Kind::whole;
    value.whole = whole;
    return value;
}

// A floating-point number of 4 or 8 bytes, the highest byte first.
inline Value unpack_real(Bytes& bytes, std::size_t n) {
    Value value;
    value.kind = Value::Kind::real;
    const std::uint64_t bits = bytes.big_endian(n);
    if (n == sizeof(double)) {
        std::memcpy(&value.real, &bits, sizeof(double));
    } else {
        const std::uint32_t half = static_cast<std::uint32_t>(bits);
        float number;
        std::memcpy(&number, &half, sizeof(float));
        value.real = number;
    }
    return value;
}

inline Value unpack_list(Bytes& bytes, std::size_t n, int depth) {
    Value value;
    value.kind = Value::Kind::list;
    for (; n > 0; --n) value.list.push_back(unpack(bytes, depth));
    return value;
}

inline Value unpack_map(Bytes& bytes, std::size_t n, int depth) {
    Value value;
    value.kind = Value::Kind::map;
    for (; n > 0; --n) {
        const std::string key = unpack(bytes, depth).as_text("key of a map");
        value.map[key] = unpack(bytes, depth);
    }
    return value;
}

// The next value of msgpack; no map or list is nested deeper than `depth`.
inline Value unpack(Bytes& bytes, int depth) {
    if (depth == 0) throw Error("message: nested too deep");
    bytes.count_value();
    const unsigned char head = bytes.take<unsigned char>();
    if (head < 0x80) return unpack_whole(head);
    if (head < 0x90) return unpack_map(bytes, head & 0x0F, depth - 1);
    if (head < 0xA0) return unpack_list(bytes, head & 0x0F, depth - 1);
    if (head < 0xC0) return unpack_text(bytes, head & 0x1F);
    if (head >= 0xE0) return unpack_whole(static_cast<signed char>(head));
    switch (head) {
        case 0xC0: return Value();
        case 0xC2: return unpack_whole(0);
        case 0xC3: return unpack_whole(1);
        case 0xC4: case 0xD9: return unpack_text(bytes, bytes.big_endian(1));
        case 0xC5: case 0xDA: return unpack_text(bytes, bytes.big_endian(2));
        case 0xC6: case 0xDB: return unpack_text(bytes, bytes.big_endian(4));
        case 0xCA: return unpack_real(bytes, 4);
        case 0xCB: return unpack_real(bytes, 8);
        case 0xCC: return unpack_whole(static_cast<std::int64_t>(bytes.big_endian(1)));
        case 0xCD: return unpack_whole(static_cast<std::int64_t>(bytes.big_endian(2)));
        case 0xCE: return unpack_whole(static_cast<std::int64_t>(bytes.big_endian(4)));
        case 0xCF: return unpack_whole(static_cast<std::int64_t>(bytes.big_endian(8)));
        case 0xD0: return unpack_whole(static_cast<std::int8_t>(bytes.big_endian(1)));
        case 0xD1: return unpack_whole(static_cast<std::int16_t>(bytes.big_endian(2)));
        case 0xD2: return unpack_whole(static_cast<std::int32_t>(bytes.big_endian(4)));
        case 0xD3: return unpack_whole(static_cast<std::int64_t>(bytes.big_endian(8)));
        case 0xDC: return unpack_list(bytes, bytes.big_endian(2), depth - 1);
        case 0xDE: return unpack_map(bytes, bytes.big_endian(2), depth - 1);
        default: throw Error("message: not a map of msgpack");
    }
}

// An array within a message; its bytes are those of the message.
struct Array {
    std::vector<std::size_t> shape;
    std::size_t n = 0;
    const unsigned char* data = nullptr;

    template <class T>
    T at(std::size_t k) const {
        T value;
        std::memcpy(&value, data + k * sizeof(T), sizeof(T));
        return value;
    }
};

inline std::vector<std::string> words(const std::string& text) {
    std::vector<std::string> parts(1);
    for (char letter : text) {
        if (letter == ' ') parts.emplace_back();
        else parts.back() += letter;
    }
    return parts;
}

// The map of a message: its topic and a zero byte come before it.
inline Value read_map(const unsigned char* data, std::size_t size, std::size_t n_topic) {
    Bytes bytes(data, size);
    bytes.take(n_topic + 1);
    Value body = unpack(bytes);
    if (body.kind != Value::Kind::map) throw Error("message: not a map of msgpack");
    if (bytes.left() != 0) throw Error("message too long");
    return body;
}

inline void check_version(const Value& body, const std::string& schema, std::int64_t known) {
    const std::string name = body["schema"].as_text("schema");
    if (name != schema) throw Error("a message of schema " + name + ", expected " + schema);
    const std::int64_t version = body["version"].as_whole("version");
    if (version != known) {
        throw Error(schema + ": version " + std::to_string(version) + "; this reader knows " +
                    std::to_string(known));
    }
}

inline void set_head(Head& head, const Value& body) {
    head.patch = body["patch"].as_text("patch");
    head.run_id = body["run_id"].as_text("run_id");
    head.stamp_ns = body["stamp_ns"].as_whole("stamp_ns");
    head.seq = body["seq"].as_whole("seq");
    // The only patch of a message has its name.
    const Value& names = body["names"];
    head.patches = words(names.is_missing() ? head.patch : names.as_text("names"));
}

// What a message has of each of its patches, `n` values; `unstated` of each where it has none.
inline std::vector<Value> of_patches(const Value& body, const char* name, std::size_t n,
                                     const Value& unstated) {
    const std::vector<Value>& list = body[name].list;
    if (list.empty()) return std::vector<Value>(n, unstated);
    if (list.size() != n) throw Error(std::string(name) + ": expected one of each patch");
    return list;
}

inline std::vector<std::int64_t> wholes(const Value& body, const char* name, std::size_t n) {
    std::vector<std::int64_t> numbers;
    for (const Value& value : of_patches(body, name, n, Value())) {
        numbers.push_back(value.as_whole(name));
    }
    return numbers;
}

inline std::vector<double> reals(const Value& body, const char* name, std::size_t n) {
    std::vector<double> numbers;
    for (const Value& value : of_patches(body, name, n, Value())) {
        numbers.push_back(value.as_real(name));
    }
    return numbers;
}

inline std::vector<bool> flags(const Value& body, const char* name, std::size_t n, bool unstated) {
    std::vector<bool> states;
    for (const Value& value : of_patches(body, name, n, unpack_whole(unstated))) {
        states.push_back(value.as_whole(name) != 0);
    }
    return states;
}

// An array of a dtype whose items have `item_size` bytes; without data where there is none.
inline Array array_of(const Value& body, const char* name, const char* dtype,
                      std::size_t item_size) {
    Array array;
    const Value& form = body[name];
    if (form.is_missing()) return array;
    if (form["dtype"].as_text(name) != dtype) throw Error(std::string(name) + ": another dtype");
    array.n = 1;
    for (const Value& side : form["shape"].list) {
        const std::int64_t n = side.as_whole(name);
        if (n < 0 || n > static_cast<std::int64_t>(max_elements)) throw Error("array too large");
        array.shape.push_back(static_cast<std::size_t>(n));
        array.n *= static_cast<std::size_t>(n);
        if (array.n > max_elements) throw Error("array too large");
    }
    const Value& bytes = form["data"];
    if (bytes.kind != Value::Kind::text || bytes.size != array.n * item_size) {
        throw Error(std::string(name) + ": its bytes do not fit its shape");
    }
    array.data = bytes.data;
    return array;
}

inline Array floats_of(const Value& body, const char* name) {
    return array_of(body, name, "<f4", sizeof(float));
}

inline Array wholes_of(const Value& body, const char* name) {
    return array_of(body, name, "<i4", sizeof(std::int32_t));
}

inline std::vector<float> floats(const Array& array) {
    std::vector<float> values(array.n);
    if (array.n > 0) std::memcpy(values.data(), array.data, array.n * sizeof(float));
    return values;
}

// A number of frames, which is left out where it is 0.
inline std::int64_t count(const Value& body, const char* name) {
    return body[name].is_missing() ? 0 : body[name].as_whole(name);
}

inline void convert(const Value& body, Reconstruction& frame) {
    check_version(body, "reconstruction", 2);
    const Array forces = floats_of(body, "forces");
    if (forces.shape.size() != 3) throw Error("forces: expected 3 sides");
    frame = Reconstruction();
    set_head(frame, body);
    frame.forces = floats(forces);
    frame.n_sent = forces.shape[0];
    frame.n_rows = forces.shape[1];
    frame.n_cols = forces.shape[2];
    frame.sd = floats(floats_of(body, "sd"));
    frame.phi = body["phi"].as_text("phi");
    frame.done_ns = body["done_ns"].as_whole("done_ns");
    frame.skipped = count(body, "skipped");
    frame.quiet = count(body, "quiet");

    const std::size_t n = frame.patches.size();
    frame.iterations = wholes(body, "iterations", n);
    frame.residual = reals(body, "residual", n);
    frame.solve_ns = wholes(body, "solve_ns", n);
    frame.error = reals(body, "error", n);
    frame.trusted = flags(body, "trusted", n, true);
    frame.unchanged = flags(body, "unchanged", n, false);
    const Value& reason = body["reason"];
    if (!reason.is_missing()) frame.reason = words(reason.as_text("reason"));
    frame.reason.resize(n);
}

// A column of contacts: `sides` numbers of each of `n`. Where it may be left out, it has no data.
inline Array column(Array array, const char* name, std::size_t n, std::size_t sides,
                    bool is_needed) {
    if (array.shape.empty() && !is_needed) return array;
    if (array.shape.empty()) throw Error(std::string("contacts without ") + name);
    if (array.n != n * sides) throw Error(std::string(name) + ": another length");
    return array;
}

// Columns of contacts, by name.
class Columns {
public:
    explicit Columns(const Value& body) : body_(body), id_(wholes_of(body, "id")) {
        if (id_.shape.empty()) throw Error("contacts without id");
    }

    std::size_t n() const { return id_.n; }

    std::int32_t id(std::size_t k) const { return id_.at<std::int32_t>(k); }

    Array floats(const char* name, std::size_t sides, bool is_needed) const {
        return column(floats_of(body_, name), name, n(), sides, is_needed);
    }

    Array wholes(const char* name, bool is_needed) const {
        return column(wholes_of(body_, name), name, n(), 1, is_needed);
    }

    Array flags(const char* name) const {
        return column(array_of(body_, name, "|b1", 1), name, n(), 1, true);
    }

private:
    const Value& body_;
    Array id_;
};

// Sets a number of each contact, of `sides` the one of an index.
inline void set_floats(std::vector<Contact>& contacts, const Array& values, float Contact::* field,
                       std::size_t sides = 1, std::size_t index = 0) {
    for (std::size_t k = 0; k < contacts.size(); ++k) {
        contacts[k].*field = values.at<float>(k * sides + index);
    }
}

// Sets the three numbers of each contact; they stay NaN where there is no such column.
inline void set_vectors(std::vector<Contact>& contacts, const Array& values,
                        float (Contact::* field)[3]) {
    if (values.data == nullptr) return;
    for (std::size_t k = 0; k < contacts.size(); ++k) {
        for (std::size_t side = 0; side < 3; ++side) {
            (contacts[k].*field)[side] = values.at<float>(3 * k + side);
        }
    }
}

inline std::vector<Contact> contacts_of(const Value& body, std::size_t n_patches) {
    const Columns columns(body);
    std::vector<Contact> contacts(columns.n());
    set_floats(contacts, columns.floats("total", 1, true), &Contact::total);
    set_floats(contacts, columns.floats("total_sd", 1, true), &Contact::total_sd);
    set_floats(contacts, columns.floats("peak", 1, true), &Contact::peak);
    set_floats(contacts, columns.floats("age_s", 1, true), &Contact::age_s);
    const Array centre = columns.floats("centre", 2, true);
    set_floats(contacts, centre, &Contact::row, 2, 0);
    set_floats(contacts, centre, &Contact::col, 2, 1);
    const Array centre_sd = columns.floats("centre_sd", 2, true);
    set_floats(contacts, centre_sd, &Contact::row_sd, 2, 0);
    set_floats(contacts, centre_sd, &Contact::col_sd, 2, 1);
    const Array velocity = columns.floats("velocity", 2, true);
    set_floats(contacts, velocity, &Contact::row_velocity, 2, 0);
    set_floats(contacts, velocity, &Contact::col_velocity, 2, 1);

    set_vectors(contacts, columns.floats("place_mm", 3, false), &Contact::place_mm);
    set_vectors(contacts, columns.floats("place_sd_mm", 3, false), &Contact::place_sd_mm);
    set_vectors(contacts, columns.floats("velocity_mm_s", 3, false), &Contact::velocity_mm_s);
    set_vectors(contacts, columns.floats("normal", 3, false), &Contact::normal);
    const Array area_mm2 = columns.floats("area_mm2", 1, false);
    if (area_mm2.data != nullptr) set_floats(contacts, area_mm2, &Contact::area_mm2);

    const Array area = columns.wholes("area", true);
    const Array patch_of = columns.wholes("patch_of", false);
    const Array over = columns.flags("over");
    const Array sliding = columns.flags("sliding");
    for (std::size_t k = 0; k < contacts.size(); ++k) {
        contacts[k].id = columns.id(k);
        contacts[k].area = area.at<std::int32_t>(k);
        contacts[k].over = over.data[k] != 0;
        contacts[k].sliding = sliding.data[k] != 0;
        if (patch_of.data == nullptr) continue;
        contacts[k].patch = static_cast<std::size_t>(patch_of.at<std::int32_t>(k));
        if (contacts[k].patch >= n_patches) throw Error("patch_of: no such patch");
    }
    return contacts;
}

inline std::vector<Event> events_of(const Value& body, std::size_t n_patches) {
    std::vector<Event> events;
    const Array rows = wholes_of(body, "events");
    for (std::size_t k = 0; k + 2 < rows.n; k += 3) {
        Event event;
        event.patch = static_cast<std::size_t>(rows.at<std::int32_t>(k));
        event.id = rows.at<std::int32_t>(k + 1);
        const std::int32_t kind = rows.at<std::int32_t>(k + 2);
        if (event.patch >= n_patches || kind < 0 || kind > 4) throw Error("bad event");
        event.kind = static_cast<EventKind>(kind);
        events.push_back(event);
    }
    return events;
}

inline void convert(const Value& body, Contacts& frame) {
    check_version(body, "contacts", 2);
    frame = Contacts();
    set_head(frame, body);
    frame.done_ns = body["done_ns"].as_whole("done_ns");
    const std::size_t n = frame.patches.size();
    frame.trusted = flags(body, "trusted", n, true);
    frame.contacts = contacts_of(body, n);
    frame.events = events_of(body, n);
}

// Number of messages that a stream had if this is its end; else -1.
inline std::int64_t end_of_stream(const Value& body) {
    const Value& schema = body["schema"];
    if (schema.kind != Value::Kind::text || schema.as_text("schema") != "end") return -1;
    return body["n_messages"].as_whole("n_messages");
}

inline void check(bool is_done, const std::string& what) {
    if (!is_done) throw Error(what + ": " + zmq_strerror(zmq_errno()));
}

}  // namespace detail

enum class Status { message, timeout, ended };

// Reads one topic of a graph, in one thread. With `newest` each message is the newest that has come;
// else all come in order. 1000 messages wait on each side. No node waits for a reader.
template <class Message>
class Reader {
public:
    Reader(const std::string& address, const std::string& topic, bool newest = false)
        : topic_(topic),
          newest_(newest),
          context_(zmq_ctx_new()),
          socket_(zmq_socket(context_, ZMQ_SUB)) {
        const std::int64_t longest = detail::max_message;
        zmq_setsockopt(socket_, ZMQ_MAXMSGSIZE, &longest, sizeof longest);
        zmq_setsockopt(socket_, ZMQ_SUBSCRIBE, topic.data(), topic.size());
        if (zmq_connect(socket_, address.c_str()) != 0) {
            const std::string why = zmq_strerror(zmq_errno());
            close();
            throw Error(address + ": " + why);
        }
    }

    ~Reader() { close(); }
    Reader(const Reader&) = delete;
    Reader& operator=(const Reader&) = delete;

    // The next message, waited for at most `timeout_ms` milliseconds, -1: without limit. Malformed
    // messages are counted and left out.
    Status next(Message& message, long timeout_ms = -1) {
        while (!ended_) {
            if (!waits(timeout_ms)) return Status::timeout;
            if (!receive(message)) continue;
            if (newest_) skip_to_newest(message);
            count(message);
            return Status::message;
        }
        count_to_end();
        return Status::ended;
    }

    // Messages between those that were read: with `newest` skipped, else lost.
    std::int64_t n_missed() const { return n_missed_; }
    std::int64_t n_unreadable() const { return n_unreadable_; }
    // Why the last of them was not read.
    const std::string& last_error() const { return last_error_; }

private:
    // Whether a message has come, waited for at most `timeout_ms` milliseconds.
    bool waits(long timeout_ms) {
        zmq_pollitem_t item{socket_, 0, ZMQ_POLLIN, 0};
        for (;;) {
            const int n_ready = zmq_poll(&item, 1, timeout_ms);
            if (n_ready >= 0) return n_ready > 0;
            detail::check(zmq_errno() == EINTR, "zmq_poll");
        }
    }

    // ZMQ_CONFLATE is not used: libzmq 4.3.4 leaks messages with it. As many as can wait are read
    // at most, so that a fast sender cannot hold a reader here.
    void skip_to_newest(Message& message) {
        Message newer;
        for (int n_read = 0; n_read < detail::max_waiting && !ended_ && waits(0); ++n_read) {
            if (receive(newer)) message = std::move(newer);
        }
    }

    void count(const Message& message) {
        if (message.run_id == run_id_ && message.seq > expected_) {
            n_missed_ += message.seq - expected_;
        }
        run_id_ = message.run_id;
        expected_ = message.seq + 1;
    }

    void count_to_end() {
        if (expected_ < 0 || n_sent_ <= expected_) return;
        n_missed_ += n_sent_ - expected_;
        expected_ = n_sent_;
    }

    bool receive(Message& message) {
        zmq_msg_t buffer;
        zmq_msg_init(&buffer);
        bool is_read = false;
        try {
            detail::check(zmq_msg_recv(&buffer, socket_, 0) >= 0, "zmq_msg_recv");
            is_read = read(static_cast<const unsigned char*>(zmq_msg_data(&buffer)),
                           zmq_msg_size(&buffer), message);
        } catch (const Error& error) {
            ++n_unreadable_;
            last_error_ = error.what();
        }
        zmq_msg_close(&buffer);
        return is_read;
    }

    bool read(const unsigned char* data, std::size_t size, Message& message) {
        // ZeroMQ subscribes by prefix.
        if (size <= topic_.size() || data[topic_.size()] != 0) return false;
        const detail::Value body = detail::read_map(data, size, topic_.size());
        n_sent_ = detail::end_of_stream(body);
        ended_ = n_sent_ >= 0;
        if (ended_) return false;
        detail::convert(body, message);
        return true;
    }

    void close() {
        zmq_close(socket_);
        zmq_ctx_term(context_);
    }

    std::string topic_;
    bool newest_;
    void* context_;
    void* socket_;
    std::string run_id_;
    std::string last_error_;
    std::int64_t expected_ = -1;
    std::int64_t n_sent_ = -1;
    std::int64_t n_missed_ = 0;
    std::int64_t n_unreadable_ = 0;
    bool ended_ = false;
};

}  // namespace sparseskin

#endif
