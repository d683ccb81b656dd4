// Reads reconstructions and contacts of a running sparseskin graph: ZeroMQ and the C++ library alone.
//
//     sparseskin::Reader<sparseskin::Contacts> reader(address, "/skin/contacts", true);
//     sparseskin::Contacts contacts;
//     while (reader.next(contacts, 50) != sparseskin::Status::ended) { ... }
//
// C++17; link with -lzmq. The address is that of `sparseskin topic info /skin/contacts`. Graphs with
// keys are not read. The wire form is described in messages/buffers.py of sparseskin; a message of
// another version of it is refused with an error that names both.
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
#include <vector>

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "the wire form is little-endian");

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
constexpr std::size_t max_elements = std::size_t{1} << 20;
constexpr std::size_t alignment = 16;
constexpr unsigned char mark = 0xC1;
constexpr std::int64_t wire_version = 3;

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

    void align() { take((alignment - at_ % alignment) % alignment); }

private:
    const unsigned char* data_;
    std::size_t size_;
    std::size_t at_ = 0;
};

// A value of msgpack: what the descriptions of frames are made of.
struct Value {
    enum class Kind { nothing, number, text, list, map };

    Kind kind = Kind::nothing;
    std::int64_t number = 0;
    std::string text;
    std::vector<Value> list;
    std::map<std::string, Value> map;

    const Value& at(const std::string& key) const {
        const auto found = map.find(key);
        if (found == map.end()) throw Error("description without " + key);
        return found->second;
    }

    std::int64_t as_number() const {
        if (kind != Kind::number) throw Error("description: expected a number");
        return number;
    }

    const std::string& as_text() const {
        if (kind != Kind::text) throw Error("description: expected a text");
        return text;
    }
};

inline Value unpack(Bytes& bytes, int depth = 8);

inline Value unpack_text(Bytes& bytes, std::size_t n) {
    Value value;
    value.kind = Value::Kind::text;
    const unsigned char* begin = bytes.take(n);
    value.text.assign(begin, begin + n);
    return value;
}

inline Value unpack_number(std::int64_t number) {
    Value value;
    value.kind = Value::Kind::number;
    value.number = number;
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
        const std::string key = unpack(bytes, depth).as_text();
        value.map[key] = unpack(bytes, depth);
    }
    return value;
}

// The next value of msgpack. Binary fields are texts, and floats are skipped: none is needed.
inline Value unpack(Bytes& bytes, int depth) {
    if (depth == 0) throw Error("description: nested too deep");
    const unsigned char head = bytes.take<unsigned char>();
    if (head < 0x80) return unpack_number(head);
    if (head < 0x90) return unpack_map(bytes, head & 0x0F, depth - 1);
    if (head < 0xA0) return unpack_list(bytes, head & 0x0F, depth - 1);
    if (head < 0xC0) return unpack_text(bytes, head & 0x1F);
    if (head >= 0xE0) return unpack_number(static_cast<signed char>(head));
    switch (head) {
        case 0xC0: return Value();
        case 0xC2: return unpack_number(0);
        case 0xC3: return unpack_number(1);
        case 0xC4: case 0xD9: return unpack_text(bytes, bytes.big_endian(1));
        case 0xC5: case 0xDA: return unpack_text(bytes, bytes.big_endian(2));
        case 0xC6: case 0xDB: return unpack_text(bytes, bytes.big_endian(4));
        case 0xCA: bytes.take(4); return Value();
        case 0xCB: bytes.take(8); return Value();
        case 0xCC: return unpack_number(static_cast<std::int64_t>(bytes.big_endian(1)));
        case 0xCD: return unpack_number(static_cast<std::int64_t>(bytes.big_endian(2)));
        case 0xCE: return unpack_number(static_cast<std::int64_t>(bytes.big_endian(4)));
        case 0xCF: return unpack_number(static_cast<std::int64_t>(bytes.big_endian(8)));
        case 0xD0: return unpack_number(static_cast<std::int8_t>(bytes.big_endian(1)));
        case 0xD1: return unpack_number(static_cast<std::int16_t>(bytes.big_endian(2)));
        case 0xD2: return unpack_number(static_cast<std::int32_t>(bytes.big_endian(4)));
        case 0xD3: return unpack_number(static_cast<std::int64_t>(bytes.big_endian(8)));
        case 0xDC: return unpack_list(bytes, bytes.big_endian(2), depth - 1);
        case 0xDE: return unpack_map(bytes, bytes.big_endian(2), depth - 1);
        default: throw Error("description: unknown type of msgpack");
    }
}

// Fields of a schema by how they travel, in the order of their declaration in sparseskin: texts;
// numbers of the message and of each patch with their type, q int64, d double, ? bool; arrays.
struct Field {
    const char* name;
    char type;
};

struct Schema {
    const char* name;
    std::int64_t version;
    std::vector<const char*> texts;
    std::vector<Field> numbers;
    std::vector<Field> of_patches;
    std::vector<Field> arrays;  // type: f float, i int32, b bool, u uint8
};

inline const Schema& schema_of(const Reconstruction&) {
    static const Schema schema{
        "reconstruction",
        2,
        {"patch", "run_id", "names", "phi", "reason"},
        {{"stamp_ns", 'q'}, {"seq", 'q'}, {"done_ns", 'q'}, {"skipped", 'q'}, {"quiet", 'q'}},
        {{"iterations", 'q'}, {"residual", 'd'}, {"solve_ns", 'q'}, {"error", 'd'},
         {"trusted", '?'}, {"unchanged", '?'}},
        {{"missing", 'u'}, {"forces", 'f'}, {"sd", 'f'}},
    };
    return schema;
}

inline const Schema& schema_of(const Contacts&) {
    static const Schema schema{
        "contacts",
        2,
        {"patch", "run_id", "names"},
        {{"stamp_ns", 'q'}, {"seq", 'q'}, {"done_ns", 'q'}},
        {{"trusted", '?'}},
        {{"id", 'i'}, {"total", 'f'}, {"total_sd", 'f'}, {"peak", 'f'}, {"centre", 'f'},
         {"centre_sd", 'f'}, {"area", 'i'}, {"velocity", 'f'}, {"age_s", 'f'}, {"over", 'b'},
         {"sliding", 'b'}, {"place_mm", 'f'}, {"place_sd_mm", 'f'}, {"velocity_mm_s", 'f'},
         {"area_mm2", 'f'}, {"normal", 'f'}, {"patch_of", 'i'}, {"events", 'i'}},
    };
    return schema;
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

// A frame, its fields by name.
struct Frame {
    std::map<std::string, std::string> texts;
    std::map<std::string, std::vector<std::int64_t>> wholes;
    std::map<std::string, std::vector<double>> reals;
    std::map<std::string, Array> arrays;
    std::vector<std::string> patches;

    const Array* array(const std::string& name) const {
        const auto found = arrays.find(name);
        return found == arrays.end() ? nullptr : &found->second;
    }
};

inline std::vector<std::string> words(const std::string& text) {
    std::vector<std::string> found(1);
    for (char letter : text) {
        if (letter == ' ') found.emplace_back();
        else found.back() += letter;
    }
    return found;
}

inline void read_number(Frame& frame, const Field& field, Bytes& bytes) {
    if (field.type == 'q') frame.wholes[field.name].push_back(bytes.take<std::int64_t>());
    if (field.type == 'd') frame.reals[field.name].push_back(bytes.take<double>());
    if (field.type == '?') frame.wholes[field.name].push_back(*bytes.take(1) != 0);
}

inline std::size_t item_size(const Field& field, const std::string& dtype) {
    static const std::map<char, std::pair<const char*, std::size_t>> forms{
        {'f', {"<f4", 4}}, {'i', {"<i4", 4}}, {'b', {"|b1", 1}}, {'u', {"|u1", 1}}};
    const auto& form = forms.at(field.type);
    if (dtype != form.first) throw Error(std::string(field.name) + ": another dtype");
    return form.second;
}

inline Array read_array(const Field& field, const Value& form, Bytes& bytes) {
    if (form.list.size() != 2) throw Error(std::string(field.name) + ": expected dtype and shape");
    const std::size_t size = item_size(field, form.list[0].as_text());
    Array array;
    array.n = 1;
    for (const Value& side : form.list[1].list) {
        const std::int64_t n = side.as_number();
        if (n < 0 || n > static_cast<std::int64_t>(max_elements)) throw Error("array too large");
        array.shape.push_back(static_cast<std::size_t>(n));
        array.n *= static_cast<std::size_t>(n);
        if (array.n > max_elements) throw Error("array too large");
    }
    bytes.align();
    array.data = bytes.take(array.n * size);
    return array;
}

inline Value read_description(const Schema& schema, Bytes& bytes) {
    const std::size_t size = bytes.take<std::uint16_t>();
    Bytes part(bytes.take(size), size);
    Value description = unpack(part);
    const std::int64_t wire = description.at("wire").as_number();
    const std::int64_t version = description.at("version").as_number();
    if (wire != wire_version || version != schema.version) {
        throw Error("wire form " + std::to_string(wire) + ", version " + std::to_string(version) +
                    "; this reader knows " + std::to_string(wire_version) + ", " +
                    std::to_string(schema.version));
    }
    if (description.at("schema").as_text() != schema.name) throw Error("another schema");
    return description;
}

// A whole message: its topic, a zero byte, the mark, the description, numbers, and arrays.
inline Frame read_frame(const Schema& schema, const unsigned char* data, std::size_t size,
                        std::size_t n_topic) {
    Bytes bytes(data, size);
    bytes.take(n_topic + 1);
    if (bytes.take<unsigned char>() != mark) throw Error("no frame");
    const Value description = read_description(schema, bytes);
    Frame frame;
    const std::vector<Value>& texts = description.at("texts").list;
    for (std::size_t k = 0; k < schema.texts.size(); ++k) {
        frame.texts[schema.texts[k]] = k < texts.size() ? texts[k].as_text() : "";
    }
    const std::string& names = frame.texts["names"];
    frame.patches = words(names.empty() ? frame.texts["patch"] : names);
    for (const Field& field : schema.numbers) read_number(frame, field, bytes);
    for (const Field& field : schema.of_patches) {
        for (std::size_t k = 0; k < frame.patches.size(); ++k) read_number(frame, field, bytes);
    }
    bytes.align();
    const std::map<std::string, Value>& forms = description.at("arrays").map;
    for (const Field& field : schema.arrays) {
        const auto form = forms.find(field.name);
        if (form == forms.end()) continue;
        frame.arrays[field.name] = read_array(field, form->second, bytes);
    }
    if (bytes.left() != 0) throw Error("message too long");
    return frame;
}

inline void set_head(Head& head, const Frame& frame) {
    head.patch = frame.texts.at("patch");
    head.run_id = frame.texts.at("run_id");
    head.patches = frame.patches;
    head.stamp_ns = frame.wholes.at("stamp_ns")[0];
    head.seq = frame.wholes.at("seq")[0];
}

inline std::vector<bool> flags(const std::vector<std::int64_t>& wholes) {
    return std::vector<bool>(wholes.begin(), wholes.end());
}

inline std::vector<float> floats(const Array& array) {
    std::vector<float> found(array.n);
    if (array.n > 0) std::memcpy(found.data(), array.data, array.n * sizeof(float));
    return found;
}

inline void convert(const Frame& frame, Reconstruction& found) {
    const Array* forces = frame.array("forces");
    if (forces == nullptr || forces->shape.size() != 3) throw Error("forces: expected 3 sides");
    found = Reconstruction();
    set_head(found, frame);
    found.forces = floats(*forces);
    found.n_sent = forces->shape[0];
    found.n_rows = forces->shape[1];
    found.n_cols = forces->shape[2];
    if (const Array* sd = frame.array("sd")) found.sd = floats(*sd);
    found.phi = frame.texts.at("phi");
    found.done_ns = frame.wholes.at("done_ns")[0];
    found.skipped = frame.wholes.at("skipped")[0];
    found.quiet = frame.wholes.at("quiet")[0];
    found.iterations = frame.wholes.at("iterations");
    found.residual = frame.reals.at("residual");
    found.solve_ns = frame.wholes.at("solve_ns");
    found.error = frame.reals.at("error");
    found.trusted = flags(frame.wholes.at("trusted"));
    found.unchanged = flags(frame.wholes.at("unchanged"));
    found.reason = words(frame.texts.at("reason"));
    found.reason.resize(found.patches.size());
}

// Entry k of a column of contacts; of `sides` numbers the one of that index. NaN: no such column.
inline float real(const Frame& frame, const char* name, std::size_t k, std::size_t sides = 1,
                  std::size_t index = 0) {
    const Array* array = frame.array(name);
    return array == nullptr ? NAN : array->at<float>(k * sides + index);
}

inline Contact contact(const Frame& frame, std::size_t k) {
    Contact found;
    found.id = frame.array("id")->at<std::int32_t>(k);
    if (const Array* of = frame.array("patch_of")) {
        found.patch = static_cast<std::size_t>(of->at<std::int32_t>(k));
    }
    found.total = real(frame, "total", k);
    found.total_sd = real(frame, "total_sd", k);
    found.peak = real(frame, "peak", k);
    found.row = real(frame, "centre", k, 2, 0);
    found.col = real(frame, "centre", k, 2, 1);
    found.row_sd = real(frame, "centre_sd", k, 2, 0);
    found.col_sd = real(frame, "centre_sd", k, 2, 1);
    found.row_velocity = real(frame, "velocity", k, 2, 0);
    found.col_velocity = real(frame, "velocity", k, 2, 1);
    found.area = frame.array("area")->at<std::int32_t>(k);
    found.age_s = real(frame, "age_s", k);
    found.over = frame.array("over")->data[k] != 0;
    found.sliding = frame.array("sliding")->data[k] != 0;
    found.area_mm2 = real(frame, "area_mm2", k);
    for (std::size_t side = 0; side < 3; ++side) {
        found.place_mm[side] = real(frame, "place_mm", k, 3, side);
        found.place_sd_mm[side] = real(frame, "place_sd_mm", k, 3, side);
        found.velocity_mm_s[side] = real(frame, "velocity_mm_s", k, 3, side);
        found.normal[side] = real(frame, "normal", k, 3, side);
    }
    return found;
}

// Number of contacts of a frame; an error where a column is missing or has another length.
inline std::size_t n_contacts(const Frame& frame) {
    static const std::map<std::string, std::size_t> sides{
        {"centre", 2}, {"centre_sd", 2}, {"velocity", 2}, {"place_mm", 3},
        {"place_sd_mm", 3}, {"velocity_mm_s", 3}, {"normal", 3}};
    for (const char* name : {"id", "total", "total_sd", "peak", "centre", "centre_sd", "area",
                             "velocity", "age_s", "over", "sliding"}) {
        if (frame.array(name) == nullptr) throw Error(std::string("contacts without ") + name);
    }
    const std::size_t n = frame.array("id")->n;
    for (const auto& [name, array] : frame.arrays) {
        const auto of = sides.find(name);
        const std::size_t n_sides = of == sides.end() ? 1 : of->second;
        if (name != "events" && array.n != n * n_sides) throw Error(name + ": another length");
    }
    return n;
}

inline void convert(const Frame& frame, Contacts& found) {
    found = Contacts();
    set_head(found, frame);
    found.done_ns = frame.wholes.at("done_ns")[0];
    found.trusted = flags(frame.wholes.at("trusted"));
    const std::size_t n = n_contacts(frame);
    for (std::size_t k = 0; k < n; ++k) {
        found.contacts.push_back(contact(frame, k));
        if (found.contacts[k].patch >= found.patches.size()) throw Error("patch_of: no such patch");
    }
    const Array* events = frame.array("events");
    for (std::size_t k = 0; events != nullptr && k + 2 < events->n; k += 3) {
        Event event;
        event.patch = static_cast<std::size_t>(events->at<std::int32_t>(k));
        event.id = events->at<std::int32_t>(k + 1);
        const std::int32_t kind = events->at<std::int32_t>(k + 2);
        if (event.patch >= found.patches.size() || kind < 0 || kind > 4) throw Error("bad event");
        event.kind = static_cast<EventKind>(kind);
        found.events.push_back(event);
    }
}

// Number of messages that a stream had if this is its end; else -1.
inline std::int64_t end_of_stream(const unsigned char* data, std::size_t size,
                                  std::size_t n_topic) {
    Bytes bytes(data, size);
    bytes.take(n_topic + 1);
    if (bytes.left() == 0 || data[n_topic + 1] == mark) return -1;
    const Value body = unpack(bytes);
    if (body.at("schema").as_text() != "end") return -1;
    return body.at("n_messages").as_number();
}

inline void check(bool is_done, const std::string& what) {
    if (!is_done) throw Error(what + ": " + zmq_strerror(zmq_errno()));
}

}  // namespace detail

enum class Status { message, timeout, ended };

// Reads one topic of a graph, in one thread. With `newest` each message is the newest that has come;
// else all come in order, and 1000 wait on each side. No node waits for a reader.
template <class Message>
class Reader {
public:
    Reader(const std::string& address, const std::string& topic, bool newest = false)
        : topic_(topic), context_(zmq_ctx_new()), socket_(zmq_socket(context_, ZMQ_SUB)) {
        const int one = 1;
        const std::int64_t longest = detail::max_message;
        if (newest) zmq_setsockopt(socket_, ZMQ_CONFLATE, &one, sizeof one);
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
            zmq_pollitem_t item{socket_, 0, ZMQ_POLLIN, 0};
            const int n_ready = zmq_poll(&item, 1, timeout_ms);
            if (n_ready < 0 && zmq_errno() == EINTR) continue;
            detail::check(n_ready >= 0, "zmq_poll");
            if (n_ready == 0) return Status::timeout;
            if (receive(message)) return Status::message;
        }
        return Status::ended;
    }

    // Messages between those that were read: with `newest` skipped, else lost.
    std::int64_t n_missed() const { return n_missed_; }
    std::int64_t n_unreadable() const { return n_unreadable_; }
    // Why the last of them was not read.
    const std::string& last_error() const { return last_error_; }

private:
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
        const std::int64_t n_sent = detail::end_of_stream(data, size, topic_.size());
        if (n_sent >= 0) {
            ended_ = true;
            if (expected_ >= 0 && n_sent > expected_) n_missed_ += n_sent - expected_;
            return false;
        }
        const detail::Schema& schema = detail::schema_of(message);
        detail::convert(detail::read_frame(schema, data, size, topic_.size()), message);
        if (message.run_id == run_id_ && message.seq > expected_) {
            n_missed_ += message.seq - expected_;
        }
        run_id_ = message.run_id;
        expected_ = message.seq + 1;
        return true;
    }

    void close() {
        zmq_close(socket_);
        zmq_ctx_term(context_);
    }

    std::string topic_;
    void* context_;
    void* socket_;
    std::string run_id_;
    std::string last_error_;
    std::int64_t expected_ = -1;
    std::int64_t n_missed_ = 0;
    std::int64_t n_unreadable_ = 0;
    bool ended_ = false;
};

}  // namespace sparseskin

#endif
