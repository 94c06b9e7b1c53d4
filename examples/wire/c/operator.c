/* An operator in C with zenoh-pico: lets the arm do a task while this program lives.

       cc -DZENOH_LINUX -o operator operator.c $(pkg-config --cflags --libs zenohpico)
       ./operator ENDPOINT ROBOT WORKER PROMPT SECONDS

   Ctrl-C is an emergency stop; put <robot>/reset clears it. */

#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <zenoh-pico.h>

#define HOLDER "c-operator"
#define SCHEMA 2
#define MOST 8192
#define DEEPEST 8
#define PATIENCE_MS 5000
#define PERIOD_MS 20

/* -- msgpack: bytes of a value, NULL where they end too early -------------------------------- */
typedef struct {
    const uint8_t *at, *end;
} bytes_t;

/* A big-endian number of `size` bytes after the first; UINT64_MAX: it is cut off. */
static uint64_t number_after(bytes_t from, size_t size) {
    uint64_t found = 0;
    if ((size_t)(from.end - from.at) < 1 + size) return UINT64_MAX;
    for (size_t i = 1; i <= size; i++) found = found << 8 | from.at[i];
    return found;
}

/* Of the value at `from`: its kind ('m'ap, 'a'rray, 's'tring, 'v' for others), the bytes of its
   head, and its length: of a string in bytes, of a map or array in values. 0: not msgpack. */
static char head_of(bytes_t from, size_t *head, uint64_t *length) {
    static const uint8_t sizes[32] = {0, 0, 0, 0, 1, 2, 4, 1, 2, 4, 4, 8, 1, 2, 4, 8,
                                      1, 2, 4, 8, 1, 1, 1, 1, 1, 1, 2, 4, 2, 4, 2, 4};
    if (from.at == NULL || from.at >= from.end) return 0;
    uint8_t first = *from.at;
    *head = 1, *length = 0;
    if (first < 0x80 || first >= 0xe0) return 'v';
    if (first < 0x90) return *length = 2 * (uint64_t)(first & 15), 'm';
    if (first < 0xa0) return *length = first & 15, 'a';
    if (first < 0xc0) return *length = first & 31, 's';
    if (first >= 0xd4 && first <= 0xd8) return 0; /* no extensions on the wire */
    if (first == 0xc1 || (first >= 0xc7 && first <= 0xc9)) return 0;
    uint8_t size = sizes[first - 0xc0];
    *head = 1 + size;
    uint64_t found = number_after(from, size);
    if (found == UINT64_MAX && size < 8) return 0;
    if (first >= 0xde) return *length = 2 * found, 'm';
    if (first >= 0xdc) return *length = found, 'a';
    if (first >= 0xd9) return *length = found, 's';
    if (first >= 0xc4 && first <= 0xc6) return *length = found, 'b';
    return 'v';
}

/* Where the value at `from` ends. */
static const uint8_t *skip(bytes_t from, int depth) {
    size_t head;
    uint64_t length;
    char kind = head_of(from, &head, &length);
    if (kind == 0 || depth == 0 || (size_t)(from.end - from.at) < head) return NULL;
    from.at += head;
    if (kind == 's' || kind == 'b') {
        return (uint64_t)(from.end - from.at) < length ? NULL : from.at + length;
    }
    for (; length > 0 && from.at != NULL; length--) from.at = skip(from, depth - 1);
    return from.at;
}

/* Whether the value at `from` is this text. */
static bool is_text(bytes_t from, const char *text) {
    size_t head;
    uint64_t length;
    if (head_of(from, &head, &length) != 's' || length != strlen(text)) return false;
    return (size_t)(from.end - from.at) >= head + length && !memcmp(from.at + head, text, length);
}

/* The value of a field of the map `from`; at is NULL where there is none. */
static bytes_t field(bytes_t from, const char *name) {
    size_t head;
    uint64_t length;
    if (head_of(from, &head, &length) != 'm') return (bytes_t){NULL, NULL};
    from.at += head;
    for (; length > 0 && from.at != NULL; length -= 2) {
        bool found = is_text(from, name);
        from.at = skip(from, DEEPEST);
        if (found) return from;
        if (from.at != NULL) from.at = skip(from, DEEPEST);
    }
    return (bytes_t){NULL, NULL};
}

static void print_text(bytes_t from) {
    size_t head;
    uint64_t length;
    if (head_of(from, &head, &length) == 's' && (size_t)(from.end - from.at) >= head + length) {
        printf(" %.*s", (int)length, (const char *)from.at + head);
    }
}

/* -- samples ---------------------------------------------------------------------------------- */
/* The record of a sample, copied to `kept`; at is NULL for what is to be rejected. */
static bytes_t record_of(const z_loaned_sample_t *sample, uint8_t kept[MOST]) {
    bytes_t none = {NULL, NULL};
    const z_loaned_bytes_t *attachment = z_sample_attachment(sample);
    const z_loaned_bytes_t *payload = z_sample_payload(sample);
    if (z_sample_kind(sample) != Z_SAMPLE_KIND_PUT || attachment == NULL) return none;
    if (z_bytes_len(attachment) > 1024 || z_bytes_len(payload) > MOST) return none;
    z_bytes_reader_t reader = z_bytes_get_reader(attachment);
    size_t size = z_bytes_reader_read(&reader, kept, MOST);
    bytes_t schema = field((bytes_t){kept, kept + size}, "schema");
    if (schema.at == NULL || *schema.at != SCHEMA) {
        fprintf(stderr, "a sample of another version than %d of the wire\n", SCHEMA);
        return none;
    }
    reader = z_bytes_get_reader(payload);
    size = z_bytes_reader_read(&reader, kept, MOST);
    bytes_t found = {kept, kept + size};
    return skip(found, DEEPEST) == found.end ? found : none;
}

static struct {
    const char *worker, *prompt;
} wanted;
static volatile sig_atomic_t taken, active, interrupted;

static void take_task(z_loaned_sample_t *sample, void *context) {
    uint8_t kept[MOST];
    bytes_t task = record_of(sample, kept), is_active = field(task, "active");
    (void)context;
    if (is_active.at == NULL) return;
    taken = is_text(field(task, "worker"), wanted.worker) &&
            is_text(field(task, "prompt"), wanted.prompt);
    active = *is_active.at == 0xc3;
}

static void show_event(z_loaned_sample_t *sample, void *context) {
    uint8_t kept[MOST];
    bytes_t event = record_of(sample, kept);
    (void)context;
    const char *names[] = {"level", "what", "why"};
    for (int i = 0; i < 3; i++) print_text(field(event, names[i]));
    printf("\n");
}

/* -- the operator ----------------------------------------------------------------------------- */
static z_owned_session_t session;
static const char *robot;

static z_view_keyexpr_t key(char full[256], const char *name) {
    z_view_keyexpr_t found;
    snprintf(full, 256, "%s/%s", robot, name);
    if (z_view_keyexpr_from_str(&found, full) < 0) {
        fprintf(stderr, "%s is no key\n", full);
        exit(1);
    }
    return found;
}

static void put(const char *name, const char *text) {
    char full[256];
    z_view_keyexpr_t where = key(full, name);
    z_owned_bytes_t payload;
    z_bytes_copy_from_str(&payload, text);
    if (z_put(z_loan(session), z_loan(where), z_move(payload), NULL) < 0) {
        fprintf(stderr, "%s cannot be put\n", full);
        exit(1);
    }
}

static void follow(z_owned_subscriber_t *to, const char *name,
                   void (*take)(z_loaned_sample_t *, void *)) {
    char full[256];
    z_view_keyexpr_t where = key(full, name);
    z_owned_closure_sample_t call;
    z_closure(&call, take, NULL, NULL);
    if (z_declare_subscriber(z_loan(session), to, z_loan(where), z_move(call), NULL) < 0) exit(1);
}

/* Whether `flag` becomes `value` in time. */
static bool becomes(volatile sig_atomic_t *flag, bool value, long ms) {
    for (; ms > 0 && *flag != value && !interrupted; ms -= PERIOD_MS) z_sleep_ms(PERIOD_MS);
    return *flag == value;
}

static void interrupt(int signal) {
    (void)signal;
    interrupted = 1;
}

int main(int count, char **words) {
    if (count != 6) {
        fprintf(stderr, "usage: %s ENDPOINT ROBOT WORKER PROMPT SECONDS\n", words[0]);
        return 2;
    }
    robot = words[2], wanted.worker = words[3], wanted.prompt = words[4];
    z_owned_config_t config;
    z_config_default(&config);
    zp_config_insert(z_loan_mut(config), Z_CONFIG_MODE_KEY, "client");
    zp_config_insert(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, words[1]);
    if (z_open(&session, z_move(config), NULL) < 0) {
        fprintf(stderr, "no router at %s\n", words[1]);
        return 1;
    }
    signal(SIGINT, interrupt);
    z_owned_subscriber_t task, events;
    follow(&task, "task", take_task);
    follow(&events, "event/command", show_event);
    put("worker", wanted.worker);
    put("prompt", wanted.prompt);
    int status = 1;
    char full[256];
    z_view_keyexpr_t where = key(full, "holding/" HOLDER);
    z_owned_liveliness_token_t deadman;
    if (!becomes(&taken, true, PATIENCE_MS)) {
        fprintf(stderr, "the command node does not take the task\n");
    } else if (z_liveliness_declare_token(z_loan(session), &deadman, z_loan(where), NULL) < 0) {
        fprintf(stderr, "no token %s\n", full);
    } else {
        put("active", "true while " HOLDER);
        if (!becomes(&active, true, PATIENCE_MS)) {
            fprintf(stderr, "the arm was not activated: the events say why\n");
        } else if (becomes(&active, false, 1000 * atol(words[5]))) {
            fprintf(stderr, "the arm was deactivated: the events say why\n");
        } else {
            status = 0;
        }
        if (interrupted) put("stop", "");
        put("active", "false");
        z_drop(z_move(deadman));
    }
    z_drop(z_move(events));
    z_drop(z_move(task));
    z_drop(z_move(session));
    return status;
}
