/* Count what an emulated program executes between two marks, block by block. A QEMU TCG plugin.
 *
 * The guest marks with a system call that does nothing else: getppid(MARK, 1, section) starts a section,
 * getppid(MARK, 0, section) ends it and writes <folder>/<section>.blocks: for every translated block that ran in
 * between six uint64, in this order: its address in the guest, how often it was entered, how many instructions, SIMD or
 * floating-point instructions, and SDOT instructions it has, and the least time on a Cortex-A76, in quarters of a cycle.
 * A section counts from the instruction after the call that starts it to the call that ends it, included.
 *
 * Exact for one running thread: counters are added to without locks, because that makes them cheap enough to be
 * compiled into each block. Loads and stores of vectors are not SIMD here: Arm encodes them as loads and stores.
 *
 * With memory=SECTION (0: every section) it also runs each load and store through a model of a Raspberry Pi 5's data
 * caches, 64 KB and 512 KB of a core and 2 MB that the cores share, and counts the lines of 64 bytes that each of them
 * lacks. It leaves <folder>/<section>.more: uint64 of the lines that loads and that stores found in no cache up to the
 * first, the second, the third.
 *
 * Use: qemu-aarch64 -plugin count.so,folder=FOLDER[,memory=SECTION] program
 * The declarations are our own because Debian 12 ships QEMU 7.2 without qemu-plugin.h. They are version 1 of the
 * plugin interface, which QEMU refuses from 9.0 on.
 */
#include <pthread.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))

typedef uint64_t qemu_plugin_id_t;
typedef struct qemu_info_t qemu_info_t;
struct qemu_plugin_tb;
struct qemu_plugin_insn;
enum qemu_plugin_op { QEMU_PLUGIN_INLINE_ADD_U64 };
typedef void (*translated_cb)(qemu_plugin_id_t, struct qemu_plugin_tb *);
typedef void (*syscall_cb)(qemu_plugin_id_t, unsigned cpu, int64_t number, uint64_t a1, uint64_t a2, uint64_t a3,
                           uint64_t a4, uint64_t a5, uint64_t a6, uint64_t a7, uint64_t a8);
extern void qemu_plugin_register_vcpu_tb_trans_cb(qemu_plugin_id_t, translated_cb);
extern void qemu_plugin_register_vcpu_syscall_cb(qemu_plugin_id_t, syscall_cb);
extern void qemu_plugin_register_vcpu_tb_exec_inline(struct qemu_plugin_tb *, enum qemu_plugin_op, void *, uint64_t);
extern size_t qemu_plugin_tb_n_insns(const struct qemu_plugin_tb *);
extern uint64_t qemu_plugin_tb_vaddr(const struct qemu_plugin_tb *);
extern struct qemu_plugin_insn *qemu_plugin_tb_get_insn(const struct qemu_plugin_tb *, size_t);
extern const void *qemu_plugin_insn_data(const struct qemu_plugin_insn *);
typedef void (*memory_cb)(unsigned cpu, uint32_t what, uint64_t address, void *unused);
extern int qemu_plugin_mem_is_store(uint32_t what);
extern void qemu_plugin_register_vcpu_mem_cb(struct qemu_plugin_insn *, memory_cb, int flags, int which, void *);

EXPORT int qemu_plugin_version = 1;

enum { GETPPID = 173, MARK = 0xC0FFEE, BLOCKS_PER_SLAB = 65536 };
enum { NO_REGISTERS = 0, READS_AND_WRITES = 3 };
enum { LEVELS = 3, LINE_BITS = 6, MOST_SETS = 2048, MOST_WAYS = 16 };
static const unsigned sets_of[LEVELS] = {256, 1024, 2048}, ways_of[LEVELS] = {4, 8, 16};

struct block {
    uint64_t entered, entered_at_start; /* `entered` is written by translated code */
    uint64_t address, instructions, simd, sdot, quarters;
};

/* Slabs never move: translated code holds pointers into them. A block that QEMU translates again gets a new entry. */
struct slab {
    struct slab *next;
    size_t used;
    struct block blocks[BLOCKS_PER_SLAB];
};

static struct slab *slabs;
static const char *folder;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static uint64_t lines[LEVELS][MOST_SETS][MOST_WAYS], last_line; /* the most recently used way first */
static struct { uint64_t fetched[LEVELS][2]; } more;
static int with_memory, active;
static uint64_t only_section; /* 0: all */

static void fail(const char *what)
{
    perror(what);
    _Exit(1);
}

static int is_simd(uint32_t word) /* Arm ARM C4.1: bits 28:25 are x111 */
{
    return (word >> 25 & 7) == 7;
}

static int is_sdot(uint32_t word) /* of 16 bytes: by vector, or by element */
{
    return (word & 0xFFE0FC00) == 0x4E809400 || (word & 0xFFC0F400) == 0x4F80E000;
}

/* What instructions take of a Cortex-A76, by Arm's optimization guide: four dispatched a cycle, two vector pipes, of which
 * the first alone multiplies integers, converts and divides, two accesses to memory of 16 bytes, one of them a store. */
struct ports {
    unsigned dispatched, vector, first, memory, stores;
};

static unsigned first_pipe(uint32_t word) /* cycles in the first vector pipe, for what no other can do */
{
    unsigned q = word >> 30 & 1, of_five = word >> 12 & 31, of_four = word >> 12 & 15;
    if ((word & 0x9F200C00) == 0x0E200000) /* widening: multiplications have bit 15 */
        return word >> 15 & 1;
    if ((word & 0x9F20F400) == 0x0E209400 || (word & 0x9F20FC00) == 0x0E20B400) /* MLA, MLS, MUL; SQDMULH */
        return 1 + q;
    if ((word & 0x9F000400) == 0x0F000000) /* by element: of integers, but SDOT */
        return !(of_four & 1) && of_four != 14;
    if ((word & 0x9F3E0C00) == 0x0E200800 && of_five >= 0x16) /* conversions, of FP32; between it and FP16 always two */
        return of_five < 0x18 ? 2 : 1 + q;
    if ((word & 0x9F7E0C00) == 0x0E780800 && of_five >= 0x18) /* conversions of FP16 */
        return 2 + 2 * q;
    if ((word & 0xBFA0FC00) == 0x2E20FC00 || (word & 0xBFE0FC00) == 0x2E403C00 || (word & 0xFF20FC00) == 0x1E201800)
        return 10; /* divisions */
    return 0;
}

static void occupy(struct ports *p, uint32_t word)
{
    static const unsigned char registers[16] = {4, 1, 4, 1, 3, 1, 3, 1, 2, 1, 2, 1, 1, 1, 1, 1};
    unsigned n = 1, vector = word >> 26 & 1;
    if ((word >> 25 & 5) == 4) { /* a load or a store */
        unsigned structure = (word & 0xBE000000) == 0x0C000000, many = structure && !(word >> 24 & 1);
        if (many)
            n = registers[word >> 12 & 15];
        else if (vector && (word & 0x3A000000) == 0x28000000 && word >> 30 == 2) /* a pair of 16 bytes each */
            n = 2;
        if (structure && (!many || !(word >> 12 & 3))) /* interleaved, or to all lanes */
            p->vector += n;
        unsigned literal = (word & 0x3B000000) == 0x18000000, more = !vector && (word & 0x38800000) == 0x38800000;
        p->stores += literal || more || word >> 22 & 1 ? 0 : n;
        p->memory += n;
    } else if (is_simd(word)) {
        unsigned first = first_pipe(word);
        p->first += first;
        p->vector += first ? first : 1;
    }
    p->dispatched += n;
}

static uint64_t quarters_of(const struct ports *p) /* the busiest, and one cycle to go on to the next block */
{
    uint64_t own[] = {2 * p->vector, 4 * p->first, 2 * p->memory, 4 * p->stores}, most = p->dispatched;
    for (unsigned i = 0; i < sizeof own / sizeof *own; i++)
        most = own[i] > most ? own[i] : most;
    return most + 4;
}

static void on_memory(unsigned cpu, uint32_t what, uint64_t address, void *unused)
{
    uint64_t line = address >> LINE_BITS;
    if (!active || line == last_line)
        return;
    last_line = line;
    for (int level = 0; level < LEVELS; level++) {
        uint64_t *ways = lines[level][line % sets_of[level]], moved = line;
        for (unsigned way = 0; way < ways_of[level]; way++) {
            uint64_t held = ways[way];
            ways[way] = moved;
            if (held == line)
                return;
            moved = held;
        }
        more.fetched[level][qemu_plugin_mem_is_store(what)]++;
    }
}

static void on_translated(qemu_plugin_id_t id, struct qemu_plugin_tb *tb)
{
    pthread_mutex_lock(&lock);
    if (!slabs || slabs->used == BLOCKS_PER_SLAB) {
        struct slab *slab = calloc(1, sizeof *slab);
        if (!slab)
            fail("count: no memory");
        slab->next = slabs;
        slabs = slab;
    }
    struct block *block = &slabs->blocks[slabs->used++];
    pthread_mutex_unlock(&lock);
    block->address = qemu_plugin_tb_vaddr(tb);
    block->instructions = qemu_plugin_tb_n_insns(tb);
    struct ports ports = {0};
    for (size_t i = 0; i < block->instructions; i++) {
        uint32_t word;
        memcpy(&word, qemu_plugin_insn_data(qemu_plugin_tb_get_insn(tb, i)), sizeof word);
        block->simd += is_simd(word);
        block->sdot += is_sdot(word);
        occupy(&ports, word);
        if (with_memory)
            qemu_plugin_register_vcpu_mem_cb(qemu_plugin_tb_get_insn(tb, i), on_memory, NO_REGISTERS, READS_AND_WRITES,
                                             NULL);
    }
    block->quarters = quarters_of(&ports);
    qemu_plugin_register_vcpu_tb_exec_inline(tb, QEMU_PLUGIN_INLINE_ADD_U64, &block->entered, 1);
}

static FILE *begin_file(uint64_t section, const char *kind)
{
    char path[4096];
    snprintf(path, sizeof path, "%s/%llu.%s", folder, (unsigned long long)section, kind);
    FILE *file = fopen(path, "wb");
    if (!file)
        fail(path);
    return file;
}

static void on_syscall(qemu_plugin_id_t id, unsigned cpu, int64_t number, uint64_t mark, uint64_t starts,
                       uint64_t section, uint64_t a4, uint64_t a5, uint64_t a6, uint64_t a7, uint64_t a8)
{
    if (number != GETPPID || mark != MARK)
        return;
    pthread_mutex_lock(&lock);
    FILE *file = NULL;
    if (starts)
        memset(&more, 0, sizeof more);
    else
        file = begin_file(section, "blocks");
    if (active) {
        FILE *beside = begin_file(section, "more");
        if (fwrite(&more, sizeof more, 1, beside) != 1 || fclose(beside))
            fail("count: cannot write");
    }
    active = starts && with_memory && (!only_section || section == only_section);
    for (struct slab *slab = slabs; slab; slab = slab->next)
        for (size_t i = 0; i < slab->used; i++) {
            struct block *b = &slab->blocks[i];
            uint64_t row[] = {b->address,      b->entered - b->entered_at_start, b->instructions, b->simd, b->sdot,
                              b->quarters};
            if (starts)
                b->entered_at_start = b->entered;
            else if (row[1] && fwrite(row, sizeof row, 1, file) != 1)
                fail("count: cannot write");
        }
    if (file && fclose(file))
        fail("count: cannot write");
    pthread_mutex_unlock(&lock);
}

EXPORT int qemu_plugin_install(qemu_plugin_id_t id, const qemu_info_t *info, int argc, char **argv)
{
    for (int i = 0; i < argc; i++)
        if (!strncmp(argv[i], "folder=", 7)) {
            folder = strdup(argv[i] + 7);
        } else if (!strncmp(argv[i], "memory=", 7)) {
            with_memory = 1;
            only_section = strtoull(argv[i] + 7, NULL, 10);
        }
    if (!folder) {
        fprintf(stderr, "count: needs folder=FOLDER\n");
        return -1;
    }
    qemu_plugin_register_vcpu_tb_trans_cb(id, on_translated);
    qemu_plugin_register_vcpu_syscall_cb(id, on_syscall);
    return 0;
}
