/* Reference firmware for the wire of docs/capture.md, version 1.
 *
 * Portable C11, no allocation after the start, no floating point library but for copying doubles.
 * What is specific to a board stands in "hardware" below: here axes that arrive at once and a
 * sensor that shows a ramp, so that the protocol can be tried on a desk. `main` speaks over
 * standard input and output; on a board, call `rig_receive` with what arrives on endpoint 0x01
 * and let `put` write to endpoint 0x81.
 *
 *   cc -std=c11 -O2 -Wall -Wextra -o rig rig.c
 */
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <time.h>
#ifndef _WIN32
#include <unistd.h>
#endif

enum { REQUEST = 1, ACK = 2, NAK = 3, EVENT = 4, DATA = 5 };
enum { HELLO = 1, STATUS = 3, HOME = 4, MOVE = 5, STOP = 6, ABORT = 7, EMERGENCY_STOP = 8,
       LAMP = 9, EXPOSE = 10, READ = 11 };
enum { HOMED_EVENT = 1, MOVED_EVENT = 2, EXPOSED_EVENT = 3, STOPPED_EVENT = 5 };
enum { UNKNOWN = 1, MALFORMED = 2, OUT_OF_RANGE = 3, NOT_HOMED = 5, STOPPED = 6, NO_FRAME = 7 };
enum { HOMED_STATE = 1, STOPPED_STATE = 8 };

#define HEAD 12
#define MOST 65536
#define AXES 4
#define WIDTH 32
#define HEIGHT 24
#define REMEMBERED 16
#define DESCRIPTION_FRAME 0xFFFFFFFFu

/* ---- hardware: replace this section -------------------------------------------------------- */

static const double LOW[AXES] = {-0.08726646, -0.08726646, -0.08726646, -0.08726646};
static const double HIGH[AXES] = {6.37045177, 1.39626340, 6.37045177, 1.48352986};
static double place[AXES];
static uint32_t lamp;

static double seconds(void) {
    struct timespec now;
    timespec_get(&now, TIME_UTC);
    return (double)(now.tv_sec % 1000000) + 1e-9 * (double)now.tv_nsec;
}
static void home_axes(void) { memcpy(place, LOW, sizeof place); }
static void move_axis(int axis, double target) { place[axis] = target; }
static double lamp_monitor(void) { return lamp ? 1.0 : 0.0; }
static void sense(double exposure_s, uint16_t *counts) {
    for (int i = 0; i < WIDTH * HEIGHT; i++) {
        double level = 64 + (lamp ? 1e5 * exposure_s * (i % WIDTH) / WIDTH : 0);
        counts[i] = (uint16_t)(level > 4095 ? 4095 : level);
    }
}
static const char DESCRIPTION[] =
    "{\"name\": \"reference firmware\", \"axes\": ["
#define AXIS(name, high, y, z)                                                                    \
    "{\"name\": \"" name "\", \"kind\": \"rotary\", \"direction\": [0, " y ", " z                 \
    "], \"point_mm\": [0, 0, 0], \"limits\": [-0.08726646, " high                                 \
    "], \"velocity\": 10.0, \"acceleration\": 100.0, \"resolution\": 1e-5}"
    AXIS("turntable", "6.37045177", "0", "1") ", " AXIS("camera_arm", "1.3962634", "1", "0") ", "
    AXIS("light_turn", "6.37045177", "0", "1") ", " AXIS("light_arm", "1.48352986", "1", "0") "], "
    "\"carries\": {\"sample\": [\"turntable\"], \"camera\": [\"camera_arm\"], "
    "\"light\": [\"light_turn\", \"light_arm\"]}, "
    "\"camera\": {\"position_mm\": [0, 0, 700], \"rotation\": [[1, 0, 0], [0, -1, 0], [0, 0, -1]], "
    "\"focal_px\": [172, 172], \"centre_px\": [15.5, 11.5]}, "
    "\"light\": {\"position_mm\": [0, 0, 900], \"radius_mm\": 3}, "
    "\"sensor\": {\"width\": 32, \"height\": 24, \"bits\": 12, \"black\": 64, \"white\": 4095, "
    "\"cfa\": \"RGGB\", \"exposure_s\": [1e-5, 10.0], \"isos\": [100.0], \"readout_s\": 0.0}, "
    "\"sources\": [\"lamp\", \"panel\"]}";

/* ---- packets ------------------------------------------------------------------------------- */

static void put16(uint8_t *to, uint32_t v) { to[0] = (uint8_t)v; to[1] = (uint8_t)(v >> 8); }
static void put32(uint8_t *to, uint32_t v) { put16(to, v); put16(to + 2, v >> 16); }
static uint32_t get16(const uint8_t *from) { return from[0] | (uint32_t)from[1] << 8; }
static uint32_t get32(const uint8_t *from) { return get16(from) | get16(from + 2) << 16; }
static void put64(uint8_t *to, double v) {
    uint64_t bits;
    memcpy(&bits, &v, 8);
    put32(to, (uint32_t)bits);
    put32(to + 4, (uint32_t)(bits >> 32));
}
static double get64(const uint8_t *from) {
    uint64_t bits = get32(from) | (uint64_t)get32(from + 4) << 32;
    double v;
    memcpy(&v, &bits, 8);
    return v;
}

static uint32_t crc32(const uint8_t *data, uint32_t size) {
    uint32_t crc = 0xFFFFFFFFu;
    while (size--) {
        crc ^= *data++;
        for (int k = 0; k < 8; k++) crc = crc >> 1 ^ (0xEDB88320u & (0u - (crc & 1)));
    }
    return ~crc;
}

static void put(const uint8_t *data, uint32_t size) {
    fwrite(data, 1, size, stdout);
    fflush(stdout);
}

static uint8_t out[HEAD + MOST + 4];

/* Frame the payload that stands at out + HEAD, and send it; the size on the wire. */
static uint32_t send(int kind, int code, uint32_t sequence, uint32_t length) {
    put16(out, 0xF1B7);
    out[2] = (uint8_t)kind;
    out[3] = (uint8_t)code;
    put16(out + 4, sequence);
    put16(out + 6, 0);
    put32(out + 8, length);
    put32(out + HEAD + length, crc32(out, HEAD + length));
    put(out, HEAD + length + 4);
    return HEAD + length + 4;
}

/* ---- state --------------------------------------------------------------------------------- */

static uint32_t boot, frames, state;
static uint8_t buffer[8 + 2 * WIDTH * HEIGHT];
static double exposing_s; /* > 0 while an exposure waits to be taken */
static int moved, homed, stopped;

/* Replies by sequence number. Replies of READ are made again: reading twice does no harm. */
static struct { uint32_t sequence, size; uint8_t data[512]; } replies[REMEMBERED];
static int next_reply;

static uint32_t put_axes(uint8_t *to) {
    for (int a = 0; a < AXES; a++) {
        put64(to + 16 * a, place[a]);
        put64(to + 16 * a + 8, place[a]);
    }
    return 16 * AXES;
}

/* The payload of a nak. */
static uint32_t refuse(uint8_t *to, int why, const char *text) {
    to[0] = (uint8_t)why;
    memcpy(to + 1, text, strlen(text));
    return 1 + (uint32_t)strlen(text);
}

static uint32_t move(uint8_t *to, const uint8_t *in, uint32_t length, int *kind) {
    if (length % 16) return *kind = NAK, refuse(to, MALFORMED, "not whole targets");
    if (!(state & HOMED_STATE)) return *kind = NAK, refuse(to, NOT_HOMED, "positions are not known");
    for (uint32_t at = 0; at < length; at += 16) {
        double target = get64(in + at + 8);
        if (in[at] >= AXES) return *kind = NAK, refuse(to, MALFORMED, "no such axis");
        /* Written so that NaN is refused. */
        if (!(target >= LOW[in[at]] - 0.02 && target <= HIGH[in[at]] + 1e-6))
            return *kind = NAK, refuse(to, OUT_OF_RANGE, "axis beyond its limit");
    }
    for (uint32_t at = 0; at < length; at += 16) move_axis(in[at], get64(in + at + 8));
    moved = 1;
    return 0;
}

static uint32_t read_part(uint8_t *to, const uint8_t *in, uint32_t length, int *kind) {
    if (length != 12) return *kind = NAK, refuse(to, MALFORMED, "READ has 12 bytes");
    uint32_t frame = get32(in), offset = get32(in + 4), size = get32(in + 8);
    const uint8_t *from = frame == DESCRIPTION_FRAME ? (const uint8_t *)DESCRIPTION : buffer;
    uint32_t whole = frame == DESCRIPTION_FRAME ? sizeof DESCRIPTION - 1 : sizeof buffer;
    if (frame != DESCRIPTION_FRAME && (frame != frames || exposing_s > 0))
        return *kind = NAK, refuse(to, NO_FRAME, "no such frame");
    if (size > MOST || offset > whole || size > whole - offset)
        return *kind = NAK, refuse(to, OUT_OF_RANGE, "beyond the buffer");
    *kind = DATA;
    memcpy(to, from + offset, size);
    return size;
}

/* Obey a command; the length of the reply's payload. */
static uint32_t obey(int code, const uint8_t *in, uint32_t length, int *kind) {
    uint8_t *to = out + HEAD;
    *kind = ACK;
    switch (code) {
    case HELLO:
        put16(to, 1);
        to[2] = AXES, to[3] = 0;
        put32(to + 4, boot);
        put32(to + 8, sizeof DESCRIPTION - 1);
        return 12;
    case STATUS:
        put32(to, state);
        put32(to + 4, lamp);
        put64(to + 8, seconds());
        put64(to + 16, lamp_monitor());
        put64(to + 24, 25.0);
        return 32 + put_axes(to + 32);
    case HOME:
        home_axes();
        state = 0;
        homed = 1;
        return 0;
    case MOVE:
        return move(to, in, length, kind);
    case STOP:
        return 0;
    case ABORT:
        stopped = exposing_s > 0;
        exposing_s = 0;
        return 0;
    case EMERGENCY_STOP:
        lamp = 0, exposing_s = 0, state = STOPPED_STATE, stopped = 1;
        return 0;
    case LAMP:
        if (length != 4) return *kind = NAK, refuse(to, MALFORMED, "LAMP has 4 bytes");
        if (get32(in) > 2) return *kind = NAK, refuse(to, OUT_OF_RANGE, "no such light");
        if (state & STOPPED_STATE && get32(in))
            return *kind = NAK, refuse(to, STOPPED, "the emergency stop holds until homing");
        lamp = get32(in);
        return 0;
    case EXPOSE: {
        if (length != 16) return *kind = NAK, refuse(to, MALFORMED, "EXPOSE has 16 bytes");
        if (!(state & HOMED_STATE)) return *kind = NAK, refuse(to, NOT_HOMED, "not homed");
        double exposure_s = get64(in);
        if (!(exposure_s > 0.99e-5 && exposure_s < 10.01) || get64(in + 8) != 100.0)
            return *kind = NAK, refuse(to, OUT_OF_RANGE, "exposure or ISO");
        exposing_s = exposure_s;
        put32(to, boot);
        put32(to + 4, ++frames);
        return 8;
    }
    case READ:
        return read_part(to, in, length, kind);
    default:
        return *kind = NAK, refuse(to, UNKNOWN, "no such command");
    }
}

/* Tell what has happened since; on a board, called from the main loop. */
static void happen(void) {
    if (stopped) stopped = 0, send(EVENT, STOPPED_EVENT, 0, 0);
    if (homed) homed = 0, state |= HOMED_STATE, send(EVENT, HOMED_EVENT, 0, 0);
    if (moved) moved = 0, send(EVENT, MOVED_EVENT, 0, 0);
    if (exposing_s > 0) {
        static uint16_t counts[WIDTH * HEIGHT];
        double exposure_s = exposing_s;
        exposing_s = 0;
        sense(exposure_s, counts);
        put32(buffer, boot);
        put32(buffer + 4, frames);
        for (int i = 0; i < WIDTH * HEIGHT; i++) put16(buffer + 8 + 2 * i, counts[i]);
        uint8_t *to = out + HEAD;
        memset(to, 0, 64);
        memcpy(to, buffer, 8);
        put16(to + 8, WIDTH);
        put16(to + 10, HEIGHT);
        put16(to + 12, 1);
        put32(to + 16, sizeof buffer);
        put32(to + 20, crc32(buffer, sizeof buffer));
        put64(to + 24, exposure_s);
        put64(to + 32, 100.0);
        put64(to + 40, seconds());
        put64(to + 48, lamp_monitor());
        put64(to + 56, 25.0);
        send(EVENT, EXPOSED_EVENT, 0, 64 + put_axes(to + 64));
    }
}

static void answer(const uint8_t *packet, uint32_t length) {
    uint32_t sequence = get16(packet + 4);
    for (int k = 0; sequence && k < REMEMBERED; k++)
        if (replies[k].sequence == sequence) {
            put(replies[k].data, replies[k].size);
            return;
        }
    int kind;
    uint32_t payload = obey(packet[3], packet + HEAD, length, &kind);
    uint32_t size = send(kind, packet[3], sequence, payload);
    if (sequence && kind != DATA && size <= sizeof replies[0].data) {
        replies[next_reply].sequence = sequence;
        replies[next_reply].size = size;
        memcpy(replies[next_reply].data, out, size);
        next_reply = (next_reply + 1) % REMEMBERED;
    }
    happen();
}

/* Bytes from the computer, in pieces of any size. */
static void rig_receive(const uint8_t *data, uint32_t size) {
    static uint8_t held[HEAD + MOST + 4];
    static uint32_t count;
    while (size--) {
        held[count++] = *data++;
        for (;;) {
            uint32_t skip = 0;
            while (skip < count && !(held[skip] == 0xB7 && (skip + 1 == count || held[skip + 1] == 0xF1)))
                skip++;
            memmove(held, held + skip, count -= skip);
            if (count < HEAD) break;
            uint32_t length = get32(held + 8);
            if (length > MOST || held[2] < REQUEST || held[2] > DATA || get16(held + 6)) {
                held[0] = 0;
                continue;
            }
            if (count < HEAD + length + 4) break;
            if (crc32(held, HEAD + length) != get32(held + HEAD + length)) {
                held[0] = 0;
                continue;
            }
            if (held[2] == REQUEST) answer(held, length);
            memmove(held, held + HEAD + length + 4, count -= HEAD + length + 4);
        }
    }
}

int main(void) {
    uint8_t byte[4096];
    long count;
    boot = (uint32_t)time(NULL);
    while ((count = (long)read(0, byte, sizeof byte)) > 0) rig_receive(byte, (uint32_t)count);
    return 0;
}
