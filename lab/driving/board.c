/* The rover's sketch for this machine: firmware/rover/rover.ino itself, with a board of virtual time around it.
 *
 * A millisecond is one turn of the sketch's loop. The chip itself is not emulated here: test that with simavr. */
#include <string.h>

#include "rover.ino"

struct event {
    uint32_t at_ms;
    uint16_t steering_us, throttle_us; /* on the pins */
    char state, reason, result, missing;
    bool signals[2];
};

struct transmitted {
    uint16_t pulse_us;   /* 0: none */
    uint16_t one_in;     /* only one in this many pulses comes */
    uint16_t misread_in; /* one in this many pulses is read as misread_us, where 0 is no pulse; 0: none is */
    uint16_t misread_us, period_us;
};

static const double BYTES_PER_MS = 11.7647; /* 117647 baud */

static struct car kept; /* in its EEPROM; the transmitter is that car's, too */
static uint32_t now;
static uint16_t boot;
static char cause;
static struct transmitted sent[2];
static uint32_t due_us[2], number[2], since_us;
static uint16_t measured_us[2], periods_us[2];
static bool fresh[2];
static char in[128], out[1024];
static uint16_t in_length, out_length;
static double waiting; /* bytes that the chip has not sent yet */
static uint8_t lost;
static uint16_t pins[2];
static struct event events[65536];
static uint32_t event_count;

const struct car *car_kept() { return &kept; }
void car_keep(const struct car *car) { (void)car; }
void pulses_begin(const struct car *car) {
    pulses_set(car, car->servos[STEERING].neutral_us, car->servos[THROTTLE].neutral_us);
}
void pulses_set(const struct car *car, uint16_t steering_us, uint16_t throttle_us) {
    (void)car;
    pins[STEERING] = steering_us;
    pins[THROTTLE] = throttle_us;
}

void receiver_begin() {}
uint32_t clock_ms() { return now; }
bool receiver_take(enum channel channel, uint16_t *pulse_us, uint16_t *period_us) {
    bool came = fresh[channel];
    fresh[channel] = false;
    *pulse_us = measured_us[channel];
    *period_us = periods_us[channel];
    return came;
}

void serial_begin() {}
int serial_take() {
    if (!in_length) return -1;
    char byte = in[0];
    memmove(in, in + 1, --in_length);
    return (uint8_t)byte;
}
bool serial_put(const char *text, uint8_t length) {
    if (waiting + length > 255) return false;
    memcpy(out + out_length, text, length);
    out_length = (uint16_t)(out_length + length);
    waiting += length;
    return true;
}
uint8_t serial_lost() {
    uint8_t n = lost;
    lost = 0;
    return n;
}

uint16_t boot_number() { return boot; }
char reset_cause() { return cause; }
void watchdog_begin() {}
void watchdog_feed() {}
void rest() {}

static void note(void) {
    struct event event = {now, pins[0], pins[1], vehicle.state, vehicle.reason, vehicle.result,
                          (char)vehicle_missing(&vehicle, now),
                          {vehicle.received[0].present, vehicle.received[1].present}};
    struct event *last = events + event_count - 1;
    event.at_ms = last->at_ms;
    if (event_count && !memcmp(last, &event, sizeof event)) return;
    event.at_ms = now;
    if (event_count < sizeof events / sizeof *events) events[event_count++] = event;
}

/* Every variable is as after power-on. car: in the EEPROM. */
void board_start(uint32_t clock, uint16_t boot_now, char cause_now, const uint16_t *car) {
    memcpy(&kept, car, sizeof kept);
    memset(&vehicle, 0, sizeof vehicle);
    memset(&reader, 0, sizeof reader);
    memset(sent, 0, sizeof sent);
    memset(due_us, 0, sizeof due_us);
    memset(number, 0, sizeof number);
    memset(fresh, 0, sizeof fresh);
    since_us = event_count = 0;
    in_length = out_length = status_ms = lost = 0;
    waiting = 0;
    status_due = false;
    now = clock;
    boot = boot_now;
    cause = cause_now;
    setup();
    note();
}

void board_transmit(int channel, uint16_t pulse_us, uint16_t one_in, uint16_t misread_in, uint16_t misread_us,
                    uint16_t period_us) {
    sent[channel] = (struct transmitted){pulse_us, one_in, misread_in, misread_us, period_us};
}

void board_give(const char *bytes, int length) {
    for (; length--; bytes++) {
        if (in_length < sizeof in)
            in[in_length++] = *bytes;
        else if (lost < UINT8_MAX)
            lost++;
    }
}

/* Lets up to `ms` milliseconds pass, but stops after one in which the sketch has said something. Returns how many passed. */
int board_run(int ms) {
    for (int n = 1; n <= ms; n++) {
        now++;
        since_us += 1000;
        waiting = waiting > BYTES_PER_MS ? waiting - BYTES_PER_MS : 0;
        for (int channel = STEERING; channel <= THROTTLE; channel++) {
            struct transmitted *from = sent + channel;
            if (since_us < due_us[channel]) continue;
            periods_us[channel] = from->period_us ? from->period_us : kept.servos[channel].period_us;
            due_us[channel] += periods_us[channel];
            if (!from->pulse_us || ++number[channel] % from->one_in) continue;
            bool misread = from->misread_in && number[channel] / from->one_in % from->misread_in == 0;
            measured_us[channel] = misread ? from->misread_us : from->pulse_us;
            fresh[channel] = measured_us[channel] != 0;
        }
        loop();
        note();
        if (out_length) return n;
    }
    return ms;
}

int board_said(char *text) {
    int length = out_length;
    memcpy(text, out, out_length);
    out_length = 0;
    return length;
}

int board_events(struct event *to) {
    int count = (int)event_count;
    memcpy(to, events, sizeof *events * event_count);
    event_count = 0;
    return count;
}

/* For a test that is host and human itself: time passes only here, and a line is read at once. */
void board_trace(int ms, uint16_t *to) {
    while (ms--) {
        board_run(1);
        out_length = 0;
        *to++ = pins[STEERING];
        *to++ = pins[THROTTLE];
    }
}

/* Returns what became of the last command. */
char board_tell(const char *bytes, int length) {
    struct command command;
    for (; length--; bytes++) {
        if (reader_take(&reader, (uint8_t)*bytes, now, &command) != READ_COMMAND || command.kind == COMMAND_HELLO)
            continue;
        vehicle_command(&vehicle, &command, now);
        vehicle_tick(&vehicle, now);
    }
    return vehicle.result;
}

/* The hello if asked for, otherwise the status. */
int board_line(bool hello, char *text) {
    struct line made;
    uint8_t length = hello ? vehicle_hello(&vehicle, cause, &made) : vehicle_status(&vehicle, now, &made);
    memcpy(text, made.text, length);
    return length;
}

bool board_may_keep() { return vehicle_may_keep(&vehicle); }
