/* An emulated Arduino Uno with a transmitter on its receiver's pins, and a ruler on its servo pins. Needs libsimavr.
 *
 * As a library (cc -shared -fPIC): stepped from a test, no clock of this world in it.
 * As a program (cc -DPROGRAM): in real time, its serial line on a pty.
 *     arduino ROVER.elf --link PATH [--log all|changes] [--reset-on-open] [--boot-ms N] [--periods S T]
 *             [--eeprom HEX]
 *         --link           a symbolic link to the pty, for pyserial to open
 *         --log            on standard output, a line each: monotonic_s,event,pin,pulse_us,period_us
 *                          all: every pulse of a servo pin, every line of the host, every event
 *                          changes: of the pulses those that differ from the one before on their pin, and no lines
 *                          monotonic_s is when the pin rose; a log that nobody reads is lost, "lost" then has how many
 *                          a line that commands a drive has its pulses, steering and throttle, in the last two fields
 *         --reset-on-open  what DTR's edge does to an Uno when its port is opened; there is none if who closed it last had
 *                          HUPCL off
 *         --boot-ms        the boot loader's time: nothing runs for so long
 *         --periods        of the transmitter's pulses, microseconds, where they are not those of the recordings' car
 *         --eeprom         its first bytes; all others are erased
 *     Where this machine stalls for more than 20 ms, so does the Arduino; the log then has "stall" with microseconds.
 *     Standard input takes, a line each: transmitter STEERING_US THROTTLE_US (0: no signal), wiggle, ready 0|1, reset,
 *     power (off and on), unplug (the port's other end hangs up; the link then leads to another), hang ADDRESS, quit. ready 1: there is a human who wiggles the stick whenever that is all that arming lacks, but not
 *     in a stopped car that nobody has opened the port of since.
 *     It ends with whoever started it.
 *
 * Written against simavr 1.6, which needs help in five places, see on_compare, match, on_flags, on_eeprom and INT1.
 */
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "avr_eeprom.h"
#include "avr_extint.h"
#include "avr_ioport.h"
#include "avr_timer.h"
#include "avr_uart.h"
#include "sim_avr.h"
#include "sim_cycle_timers.h"
#include "sim_elf.h"
#include "sim_interrupts.h"

enum { HZ = 16000000, BYTE_CYCLES = HZ / 11520, QUEUE = 1 << 16 }; /* 8N1 at 115200 */
enum { STEERING, THROTTLE, CHANNELS };
enum event_kind { PULSE = 1, CUT = 2, LINE_IN = 3, RESET = 4 }; /* CUT: a pulse that a reset ended */
static double period_us_of[CHANNELS] = {21316, 1016}; /* the transmitter's, unless a test asks for another */

struct uno_event {
    double at_us; /* PULSE, CUT: when the pin rose. LINE_IN: when the host's line was wholly in. */
    double pulse_us, period_us; /* period_us: since the pin rose before that, 0 for the first after a reset */
    /* LINE_IN: the two pulses that a drive command asks for, otherwise 0 */
    int32_t kind, channel;
};

struct channel {
    struct uno *uno;
    avr_irq_t *out, *in;          /* the servo's pin, the receiver's pin */
    avr_cycle_count_t rise, rise_before;
    bool high;
    double sent_us, period_us;    /* the transmitter's pulse; 0: none */
    double now_us;                /* the one that is on */
    bool in_high;
};
static const double WIGGLE_US[2] = {1750, 1150};
enum { WIGGLE_SIDE_CYCLES = HZ / 1000 * 70 }; /* at each side: three pulses */

struct uno {
    avr_t *avr;
    avr_irq_t *serial_in;
    avr_uart_t *uart;
    struct channel channels[CHANNELS];
    uint16_t queue[QUEUE];
    char line[128]; /* of the host, so far */
    size_t line_length;
    uint8_t output[QUEUE];
    struct uno_event events[QUEUE];
    unsigned queue_head, queue_tail, output_head, output_tail, event_head, event_tail;
    avr_cycle_count_t wiggle_end; /* of the steering stick */
    uint32_t watch_from, watch_to; /* flash addresses: the longest way from the one to the other is measured */
    avr_cycle_count_t watched_from, longest;
    uint32_t hung_at; /* flash address of the instruction that hang replaced, 0: none */
    uint8_t hung_code[2];
    void (*chip_reset)(avr_t *);
    avr_io_write_t eeprom;
    void *eeprom_param;
};

static double us(avr_cycle_count_t cycles) { return cycles * 1e6 / HZ; }

static void event(struct uno *uno, enum event_kind kind, int channel, double at_us, double pulse_us, double period_us) {
    uno->events[uno->event_head++ % QUEUE] = (struct uno_event){at_us, pulse_us, period_us, (int32_t)kind, channel};
}

static void on_servo_pin(struct avr_irq_t *irq, uint32_t value, void *param) {
    struct channel *channel = param;
    struct uno *uno = channel->uno;
    bool high = value & 1;
    (void)irq;
    if (high == channel->high) return;
    channel->high = high;
    if (high) {
        channel->rise_before = channel->rise;
        channel->rise = uno->avr->cycle;
        return;
    }
    event(uno, PULSE, (int)(channel - uno->channels), us(channel->rise), us(uno->avr->cycle - channel->rise),
          channel->rise_before ? us(channel->rise - channel->rise_before) : 0);
}

static void on_serial_out(struct avr_irq_t *irq, uint32_t value, void *param) {
    struct uno *uno = param;
    (void)irq;
    uno->output[uno->output_head++ % QUEUE] = (uint8_t)value;
}

/* In normal mode simavr 1.6 gives a timer's pins the overflows of fast PWM as well, and forgets a match when the next is
 * written. So there the compare matches of Timer2's second output are made here: at each the pin is set, cleared or left
 * alone as COM2B says then. */
static avr_cycle_count_t match(avr_t *avr, avr_cycle_count_t when, void *param) {
    avr_timer_comp_t *compare = param;
    avr_timer_t *timer = compare->timer;
    if (timer->wgm_op_mode_kind != avr_timer_wgm_normal || !timer->cs_div_value) return 0;
    uint8_t does = avr_regbit_get(avr, compare->com);
    if (does == avr_timer_com_clear || does == avr_timer_com_set)
        avr_raise_irq(timer->io.irq + TIMER_IRQ_OUT_COMP + (compare - timer->comp), does == avr_timer_com_set);
    avr_raise_interrupt(avr, &compare->interrupt);
    return when + timer->tov_cycles;
}

static void on_match_written(struct avr_t *avr, avr_timer_comp_t *compare) {
    avr_timer_t *timer = compare->timer;
    compare->comp_cycles = 0; /* none of simavr's own */
    avr_cycle_count_t round = timer->tov_cycles, due = (avr_cycle_count_t)(avr->data[compare->r_ocr] + 1) * timer->cs_div_value;
    avr_cycle_count_t now = (avr->cycle - timer->tov_base) % round;
    avr_cycle_timer_register(avr, due > now ? due - now : due + round - now, match, compare);
}

/* simavr 1.6 applies what is written to OCRnx in the fast PWM modes with TOP in a register either never (ICRn) or at
 * once, raising the pin again in the middle of a period (OCRnA). The chip takes it over at the next overflow, and so
 * does simavr if it finds it in comp_cycles then. */
static void on_compare(struct avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    avr_timer_comp_t *compare = param;
    avr_timer_t *timer = compare->timer;
    avr->data[address] = value;
    if (timer->name == '2' && compare == &timer->comp[1]) {
        avr_cycle_timer_cancel(avr, match, compare);
        if (timer->wgm_op_mode_kind == avr_timer_wgm_normal && timer->tov_cycles) {
            on_match_written(avr, compare);
            return;
        }
    }
    uint32_t ticks = avr->data[compare->r_ocr] | (compare->r_ocrh ? avr->data[compare->r_ocrh] << 8 : 0);
    if (timer->tov_cycles) /* running; a stopped timer reads OCRnx when it is started */
        compare->comp_cycles = ticks <= timer->tov_top ? (ticks + 1) * timer->cs_div_value : 0;
    if (timer->tov_cycles && timer->name == '1' && compare == timer->comp) { /* TOP, from the next period on */
        timer->tov_top = ticks;
        timer->tov_cycles = (ticks + 1) * timer->cs_div_value;
    }
}

/* simavr 1.6 clears all flags of a timer when any is written; the chip clears those written as 1. */
static void on_flags(struct avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    avr_timer_t *timer = param;
    avr_int_vector_t *vectors[] = {&timer->overflow, &timer->icr, &timer->comp[0].interrupt, &timer->comp[1].interrupt};
    for (size_t i = 0; i < sizeof vectors / sizeof *vectors; i++)
        if (vectors[i]->raised.reg == address && value >> vectors[i]->raised.bit & 1)
            avr_clear_interrupt(avr, vectors[i]);
}

/* simavr 1.6 writes the EEPROM in no time; the chip is busy with a byte for 3.4 ms. */
enum { EECR = 0x3F, EEPE = 2, EEMPE = 4 };

static avr_cycle_count_t written(avr_t *avr, avr_cycle_count_t when, void *param) {
    (void)when, (void)param;
    avr->data[EECR] &= (uint8_t)~EEPE;
    return 0;
}

static void on_eeprom(struct avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct uno *uno = param;
    bool writes = avr->data[EECR] & EEMPE && value & EEPE;
    uno->eeprom(avr, address, value, uno->eeprom_param);
    if (!writes) return;
    avr->data[EECR] |= EEPE;
    avr_cycle_timer_register(avr, HZ / 1000 * 34 / 10, written, NULL);
}

static avr_cycle_count_t feed(avr_t *avr, avr_cycle_count_t when, void *param) {
    struct uno *uno = param;
    if (uno->queue_head == uno->queue_tail) return 0;
    uint16_t byte = uno->queue[uno->queue_tail++ % QUEUE];
    avr_raise_irq(uno->serial_in, byte);
    if (byte != '\n') {
        if (uno->line_length < sizeof uno->line - 1) uno->line[uno->line_length++] = (char)byte;
    } else {
        unsigned steering_us, throttle_us;
        uno->line[uno->line_length] = 0;
        uno->line_length = 0;
        if (sscanf(uno->line, ">D %*u %*u %*u %u %u*", &steering_us, &throttle_us) != 2) steering_us = throttle_us = 0;
        /* The byte is with the program one byte's time after simavr was given it. */
        event(uno, LINE_IN, -1, us(avr->cycle + BYTE_CYCLES), steering_us, throttle_us);
    }
    return when + (uno->uart->cycles_per_byte > BYTE_CYCLES ? uno->uart->cycles_per_byte : BYTE_CYCLES);
}

static avr_cycle_count_t cycles(double microseconds) { return (avr_cycle_count_t)(microseconds * HZ / 1e6 + 0.5); }

/* Of the pulse that begins now. */
static double stick_us(const struct channel *channel, avr_cycle_count_t now) {
    avr_cycle_count_t end = channel->uno->wiggle_end;
    if (channel->uno->channels + STEERING != channel || now >= end) return channel->sent_us;
    return WIGGLE_US[now + WIGGLE_SIDE_CYCLES >= end];
}

static avr_cycle_count_t transmit(avr_t *avr, avr_cycle_count_t when, void *param) {
    struct channel *channel = param;
    (void)avr;
    if (channel->in_high) {
        channel->in_high = false;
        avr_raise_irq(channel->in, 0);
        return channel->sent_us > 0 ? when + cycles(channel->period_us - channel->now_us) : 0;
    }
    if (channel->sent_us <= 0) return 0;
    channel->in_high = true;
    channel->now_us = stick_us(channel, when);
    avr_raise_irq(channel->in, 1);
    return when + cycles(channel->now_us);
}

/* Called in each reset, the watchdog's included, after simavr forgot its cycle timers. */
static void on_reset(avr_t *avr) {
    struct uno *uno = avr->custom.data;
    if (uno->chip_reset) uno->chip_reset(avr);
    if (uno->hung_at) {
        memcpy(avr->flash + uno->hung_at, uno->hung_code, 2);
        uno->hung_at = 0;
    }
    event(uno, RESET, -1, us(avr->cycle), 0, 0);
    for (int i = 0; i < CHANNELS; i++) {
        struct channel *channel = &uno->channels[i];
        if (!channel->out) continue; /* avr_init's own reset */
        if (channel->high) event(uno, CUT, i, us(channel->rise), us(avr->cycle - channel->rise), 0);
        channel->high = false;
        channel->rise = channel->rise_before = 0;
        avr_raise_irq(channel->out, 0); /* a pin of a chip in reset floats; the servo's side pulls it down */
        if (channel->sent_us > 0 || channel->in_high)
            avr_cycle_timer_register(avr, cycles(1), transmit, channel);
    }
    if (uno->queue_head != uno->queue_tail) avr_cycle_timer_register(avr, BYTE_CYCLES, feed, uno);
}

static void no_sleep(avr_t *avr, avr_cycle_count_t cycles_to_sleep) {
    (void)avr;
    (void)cycles_to_sleep; /* simulated time passes by itself */
}

struct uno *uno_new(const char *elf) {
    elf_firmware_t firmware;
    memset(&firmware, 0, sizeof firmware);
    if (elf_read_firmware(elf, &firmware)) return NULL;
    struct uno *uno = calloc(1, sizeof *uno);
    avr_t *avr = avr_make_mcu_by_name("atmega328p");
    if (!uno || !avr) return NULL;
    uno->avr = avr;
    avr_init(avr);
    avr->log = LOG_ERROR;
    avr->sleep = no_sleep;
    firmware.frequency = HZ;
    strcpy(firmware.mmcu, "atmega328p");
    avr_load_firmware(avr, &firmware);
    avr->frequency = HZ;

    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~(uint32_t)(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    uno->serial_in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_serial_out, uno);

    for (avr_io_t *io = avr->io_port; io; io = io->next) {
        if (!strcmp(io->kind, "uart")) uno->uart = (avr_uart_t *)io;
        avr_timer_t *timer = (avr_timer_t *)io;
        if (strcmp(io->kind, "timer") || (timer->name != '1' && timer->name != '2')) continue;
        avr->io[AVR_DATA_TO_IO(timer->overflow.raised.reg)].w.c = on_flags;
        avr->io[AVR_DATA_TO_IO(timer->overflow.raised.reg)].w.param = timer;
        for (int i = 0; i < AVR_TIMER_COMP_COUNT; i++) {
            if (!timer->comp[i].r_ocr) continue;
            avr->io[AVR_DATA_TO_IO(timer->comp[i].r_ocr)].w.c = on_compare;
            avr->io[AVR_DATA_TO_IO(timer->comp[i].r_ocr)].w.param = &timer->comp[i];
        }
    }

    uno->eeprom = avr->io[AVR_DATA_TO_IO(EECR)].w.c;
    uno->eeprom_param = avr->io[AVR_DATA_TO_IO(EECR)].w.param;
    avr->io[AVR_DATA_TO_IO(EECR)].w.c = on_eeprom;
    avr->io[AVR_DATA_TO_IO(EECR)].w.param = uno;

    static const struct { char out, out_bit, in, in_bit; } PINS[CHANNELS] = {{'B', 2, 'D', 2}, {'D', 3, 'B', 0}};
    for (int i = 0; i < CHANNELS; i++) {
        struct channel *channel = &uno->channels[i];
        channel->uno = uno;
        channel->out = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(PINS[i].out), PINS[i].out_bit);
        channel->in = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(PINS[i].in), PINS[i].in_bit);
        avr_irq_register_notify(channel->out, on_servo_pin, channel);
    }
    avr->custom.data = uno;
    uno->chip_reset = avr->reset;
    avr->reset = on_reset;
    return uno;
}

void uno_free(struct uno *uno) {
    avr_terminate(uno->avr);
    free(uno);
}

double uno_now_us(struct uno *uno) { return us(uno->avr->cycle); }

/* Bytes for the serial line, behind those still waiting. A byte | 0x8000 comes with a framing error. */
void uno_send(struct uno *uno, const uint16_t *bytes, int n) {
    if (uno->queue_head == uno->queue_tail) avr_cycle_timer_register(uno->avr, 1, feed, uno);
    while (n-- > 0 && uno->queue_head - uno->queue_tail < QUEUE) uno->queue[uno->queue_head++ % QUEUE] = *bytes++;
}

/* The transmitter's pulse from its next one on; 0: no signal. period_us 0: the nominal one. */
void uno_transmitter(struct uno *uno, int index, double pulse_us, double period_us) {
    struct channel *channel = &uno->channels[index];
    bool idle = channel->sent_us <= 0 && !channel->in_high;
    channel->sent_us = pulse_us;
    channel->period_us = period_us > 0 ? period_us : period_us_of[index];
    if (idle && pulse_us > 0) avr_cycle_timer_register(uno->avr, 1, transmit, channel);
}

/* The human moves the steering stick to one side, to the other, and lets go of it. */
void uno_wiggle(struct uno *uno) { uno->wiggle_end = uno->avr->cycle + 2 * WIGGLE_SIDE_CYCLES; }

/* From now on the longest way from one flash address to another is measured. */
void uno_watch(struct uno *uno, uint32_t from, uint32_t to) {
    uno->watch_from = from;
    uno->watch_to = to;
    uno->watched_from = uno->longest = 0;
}

double uno_longest_us(struct uno *uno) { return us(uno->longest); }

/* The reset button. */
void uno_reset(struct uno *uno) {
    avr_reset(uno->avr);
    avr_regbit_set(uno->avr, uno->avr->reset_flags.extrf);
}

/* Off and on: the EEPROM is all that stays. */
void uno_power(struct uno *uno) {
    memset(uno->avr->data + uno->avr->ioend + 1, 0x5A, uno->avr->ramend - uno->avr->ioend);
    avr_reset(uno->avr);
    avr_regbit_set(uno->avr, uno->avr->reset_flags.porf);
}

/* The first n bytes of the EEPROM, read or written. */
void uno_eeprom(struct uno *uno, uint8_t *bytes, uint32_t n, bool write) {
    avr_eeprom_desc_t desc = {write ? bytes : NULL, 0, n};
    avr_ioctl(uno->avr, write ? AVR_IOCTL_EEPROM_SET : AVR_IOCTL_EEPROM_GET, &desc);
    if (!write) memcpy(bytes, desc.ee, n);
}

/* The code at a flash address becomes an endless loop, until the next reset. */
void uno_hang(struct uno *uno, uint32_t address) {
    static const uint8_t LOOP[2] = {0xFF, 0xCF}; /* rjmp to itself */
    uno->hung_at = address;
    memcpy(uno->hung_code, uno->avr->flash + address, 2);
    memcpy(uno->avr->flash + address, LOOP, 2);
}

/* 0: fine. Otherwise simavr's state: the program stopped or crashed. */
int uno_run_us(struct uno *uno, double microseconds) {
    avr_cycle_count_t end = uno->avr->cycle + cycles(microseconds);
    /* INT1, which nobody uses, is on the throttle's pin. While that is low, simavr looks at it in every second cycle, ten
     * times the work of all the rest, unless told not to; a reset forgets that. */
    avr_extint_set_strict_lvl_trig(uno->avr, 1, 0);
    while (uno->avr->cycle < end) {
        if (uno->watch_from && uno->avr->pc == uno->watch_from) uno->watched_from = uno->avr->cycle;
        if (uno->watched_from && uno->avr->pc == uno->watch_to) {
            avr_cycle_count_t took = uno->avr->cycle - uno->watched_from;
            if (took > uno->longest) uno->longest = took;
            uno->watched_from = 0;
        }
        int state = avr_run(uno->avr);
        if (state == cpu_Done || state == cpu_Crashed) return state;
    }
    return 0;
}

int uno_read(struct uno *uno, uint8_t *bytes, int n) {
    int i = 0;
    while (i < n && uno->output_tail != uno->output_head) bytes[i++] = uno->output[uno->output_tail++ % QUEUE];
    return i;
}

int uno_events(struct uno *uno, struct uno_event *events, int n) {
    int i = 0;
    while (i < n && uno->event_tail != uno->event_head) events[i++] = uno->events[uno->event_tail++ % QUEUE];
    return i;
}

#ifdef PROGRAM
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <poll.h>
#include <pty.h>
#include <sys/ioctl.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

static double monotonic(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + (double)t.tv_nsec * 1e-9;
}

enum { PINS_NONE, PINS_CHANGES, PINS_ALL };
static const double CHANGE_US = 0.4; /* an edge is known to 0.25 us, the finest timer steps by 0.5 us */

static struct {
    int fd, what;
    unsigned lost;
    struct uno_event last[CHANNELS];
} pin_log;
/* A human who sees to it that the car can be armed. */
static struct {
    bool ready;
    bool asked;         /* the port was opened since the car was armed last */
    double wiggled_us;  /* when, by the Arduino's clock */
    char line[128];     /* of the Arduino, so far */
    size_t length;
} human;
static const double WIGGLE_EVERY_US = 2.5e6;

/* The Arduino does not wait for who reads its log. */
static void put_log(double at_s, const char *what, const char *pin, double pulse_us, double period_us) {
    if (!pin_log.what) return;
    if (pin_log.lost && dprintf(pin_log.fd, "%.6f,lost,,%u,0\n", at_s, pin_log.lost) > 0) pin_log.lost = 0;
    if (dprintf(pin_log.fd, "%.6f,%s,%s,%.2f,%.2f\n", at_s, what, pin, pulse_us, period_us) < 0) pin_log.lost++;
}

static void log_event(const struct uno_event *event, double start_s) {
    static const char *const EVENTS[] = {"", "pulse", "cut", "line", "reset"};
    static const char *const PINS[] = {"", "steering", "throttle"};
    if (pin_log.what == PINS_CHANGES && event->kind == LINE_IN) return;
    if (event->kind == PULSE) {
        struct uno_event last = pin_log.last[event->channel];
        pin_log.last[event->channel] = *event;
        if (pin_log.what == PINS_CHANGES && fabs(event->pulse_us - last.pulse_us) < CHANGE_US &&
            fabs(event->period_us - last.period_us) < CHANGE_US)
            return;
    }
    put_log(start_s + event->at_us * 1e-6, EVENTS[event->kind], PINS[event->channel + 1], event->pulse_us,
            event->period_us);
}

/* start_s: when simulated time was 0. */
static void log_events(struct uno *uno, double start_s) {
    struct uno_event events[256];
    for (int n; (n = uno_events(uno, events, 256));)
        for (int i = 0; i < n; i++) log_event(&events[i], start_s);
}

/* What the Arduino says, byte by byte. */
static void human_reads(struct uno *uno, uint8_t byte) {
    char state, missing;
    if (byte != '\n') {
        if (human.length < sizeof human.line - 1) human.line[human.length++] = (char)byte;
        return;
    }
    human.line[human.length] = 0;
    human.length = 0;
    if (sscanf(human.line, "<S %*u %*u %*u %*c %c %*c %c", &state, &missing) != 2) return;
    if (state == 'A') human.asked = false;
    bool may = state == 'M' || (state == 'S' && human.asked);
    if (!human.ready || !may || missing != 'w' || uno_now_us(uno) - human.wiggled_us < WIGGLE_EVERY_US) return;
    human.wiggled_us = uno_now_us(uno);
    uno_wiggle(uno);
}

static const char *link_path;
static int master = -1; /* of the pty */
static char pty_name[64];

/* Plug the serial cable in, for the first time or after pulling it out. */
static bool plug(void) {
    int slave;
    struct termios raw;
    memset(&raw, 0, sizeof raw);
    cfmakeraw(&raw);
    raw.c_cflag |= HUPCL | CREAD | CLOCAL; /* as a serial port's is */
    if (master >= 0) close(master);
    if (openpty(&master, &slave, pty_name, &raw, NULL)) {
        perror("arduino: openpty");
        return false;
    }
    close(slave); /* so that POLLHUP tells whether somebody has the port open */
    fcntl(master, F_SETFL, O_NONBLOCK);
    unlink(link_path);
    if (symlink(pty_name, link_path)) {
        perror(link_path);
        return false;
    }
    return true;
}

/* false: quit. */
static bool obey(struct uno *uno, const char *line) {
    double steering_us, throttle_us;
    unsigned address;
    int ready;
    if (sscanf(line, "transmitter %lf %lf", &steering_us, &throttle_us) == 2) {
        uno_transmitter(uno, STEERING, steering_us, 0);
        uno_transmitter(uno, THROTTLE, throttle_us, 0);
    } else if (sscanf(line, "hang %x", &address) == 1) {
        uno_hang(uno, address);
    } else if (sscanf(line, "ready %d", &ready) == 1) {
        human.ready = ready;
    } else if (!strncmp(line, "wiggle", 6)) {
        uno_wiggle(uno);
    } else if (!strncmp(line, "reset", 5)) {
        uno_reset(uno);
    } else if (!strncmp(line, "power", 5)) {
        uno_power(uno);
    } else if (!strncmp(line, "unplug", 6)) {
        return plug();
    } else if (!strncmp(line, "quit", 4)) {
        return false;
    } else {
        fprintf(stderr, "arduino: not understood: %s\n", line);
    }
    return true;
}

/* Whether DTR stays up although the port was closed. What a real port forgets then, a pty is made to forget too. */
static bool stays_up(void) {
    struct termios now;
    int port = open(pty_name, O_RDWR | O_NOCTTY);
    if (port >= 0) {
        ioctl(port, TIOCNXCL);
        close(port);
    }
    return tcgetattr(master, &now) == 0 && !(now.c_cflag & HUPCL); /* a pty's master tells those of its other end */
}

int main(int argc, char **argv) {
    const char *elf = NULL, *log = NULL, *eeprom = "";
    bool reset_on_open = false;
    double boot_s = 0;
    for (int i = 1; i < argc; i++) {
        bool more = i + 1 < argc;
        if (!strcmp(argv[i], "--link") && more) link_path = argv[++i];
        else if (!strcmp(argv[i], "--log") && more) log = argv[++i];
        else if (!strcmp(argv[i], "--boot-ms") && more) boot_s = atof(argv[++i]) * 1e-3;
        else if (!strcmp(argv[i], "--eeprom") && more) eeprom = argv[++i];
        else if (!strcmp(argv[i], "--reset-on-open")) reset_on_open = true;
        else if (!strcmp(argv[i], "--periods") && i + 2 < argc) {
            period_us_of[STEERING] = atof(argv[++i]);
            period_us_of[THROTTLE] = atof(argv[++i]);
        } else elf = argv[i];
    }
    if (log) pin_log.what = !strcmp(log, "all") ? PINS_ALL : !strcmp(log, "changes") ? PINS_CHANGES : PINS_NONE;
    if (!elf || !link_path || (log && !pin_log.what)) {
        fprintf(stderr, "usage: arduino ROVER.elf --link PATH [--log all|changes] [--reset-on-open] [--boot-ms N] "
                        "[--periods S T] [--eeprom HEX]\n");
        return 2;
    }
    pid_t parent = getppid();
    pin_log.fd = dup(1);
    dup2(2, 1); /* simavr also talks on standard output */
    fcntl(pin_log.fd, F_SETFL, O_NONBLOCK);
    struct uno *uno = uno_new(elf);
    if (!uno) {
        fprintf(stderr, "arduino: cannot load %s\n", elf);
        return 1;
    }
    uint8_t kept[64];
    uint32_t bytes_kept = 0;
    for (unsigned byte; bytes_kept < sizeof kept && sscanf(eeprom + 2 * bytes_kept, "%2x", &byte) == 1;)
        kept[bytes_kept++] = (uint8_t)byte;
    uno_eeprom(uno, kept, bytes_kept, true);
    if (!plug()) return 1;
    double start = monotonic(); /* when simulated time was 0 */
    bool open = false, running = true, dtr = false;
    int state = 0;
    char input[128];
    size_t input_length = 0;
    /* Not only when standard input ends: another child may hold the other end of that open. */
    while (running && !state && getppid() == parent) {
        state = uno_run_us(uno, 500);
        struct pollfd files[2] = {{master, POLLIN, 0}, {0, POLLIN, 0}};
        double ahead = start + uno_now_us(uno) * 1e-6 - monotonic();
        poll(files, 2, 0);
        if (ahead < -0.02) { /* this machine had no time for us: the Arduino stood still too, rather than hurry now */
            put_log(monotonic(), "stall", "", -ahead * 1e6, 0);
            start -= ahead;
        }
        log_events(uno, start);
        bool open_now = !(files[0].revents & POLLHUP);
        if (open_now && !open) {
            put_log(monotonic(), "open", "", 0, 0);
            human.asked = true;
            if (reset_on_open && !dtr) {
                uno_reset(uno);
                log_events(uno, start);
                start += boot_s; /* stands still for so long */
                ahead += boot_s;
            }
        }
        if (open && !open_now) dtr = stays_up();
        open = open_now;
        if (files[0].revents & POLLIN) {
            uint8_t bytes[512];
            uint16_t words[512];
            ssize_t n = read(master, bytes, sizeof bytes);
            for (ssize_t i = 0; i < n; i++) words[i] = bytes[i];
            if (n > 0) uno_send(uno, words, (int)n);
        }
        if (files[1].revents & (POLLIN | POLLHUP)) {
            ssize_t n = read(0, input + input_length, sizeof input - 1 - input_length);
            if (n <= 0) break; /* whoever started it is gone */
            input_length += (size_t)n;
            input[input_length] = 0;
            for (char *end; (end = strchr(input, '\n'));) {
                *end = 0;
                running = obey(uno, input) && running;
                input_length -= (size_t)(end + 1 - input);
                memmove(input, end + 1, input_length + 1);
            }
            if (input_length == sizeof input - 1) input_length = 0;
        }
        uint8_t bytes[512];
        int n = uno_read(uno, bytes, sizeof bytes);
        for (int i = 0; i < n; i++) human_reads(uno, bytes[i]);
        /* What nobody reads is lost, as on a wire. */
        if (n > 0 && open && write(master, bytes, (size_t)n) < 0 && errno != EAGAIN) perror("arduino: write");
        if (ahead > 0) {
            struct timespec pause = {(time_t)ahead, (long)((ahead - (double)(time_t)ahead) * 1e9)};
            nanosleep(&pause, NULL);
        }
    }
    unlink(link_path);
    if (state) fprintf(stderr, "arduino: the program stopped: simavr's state %d\n", state);
    return state != 0;
}
#endif
