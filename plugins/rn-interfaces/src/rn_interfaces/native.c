/* What the ROS middleware calls of a type support that is made at run time.
 *
 * Fast DDS calls serialize, deserialize and size with the lock of a writer or reader held. None of
 * them is Python: a thread that waits for the interpreter's lock in there, while another one holds
 * it and waits for the lock of Fast DDS, would wait forever.
 *
 * It calls others through `functions`, so that it compiles without the ROS wheels.
 * rn_interfaces/library.py compiles it.
 */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define EXPORT __attribute__((visibility("default")))

struct functions {
  void *(*write)(void *cdr, const char *data, size_t size);
  char *(*begin)(void *cdr);
  char *(*place)(void *cdr);
  void *(*allocate)(size_t size);
  void (*release)(void *memory);
  void *(*copy)(void *to, const void *from, size_t size);
  int (*compare)(const char *one, const char *other);
};

struct part {
  const char *data;
  size_t size;
};

/* A ROS message as rclpy passes it around. */
struct block {
  const char *data; /* CDR to write, and what follows it */
  size_t size;
  const struct part *parts;
  size_t count;
  size_t total;
  char *taken; /* CDR that was read; its reader frees it */
  size_t taken_size;
  const int64_t *program;
  const struct functions *functions;
};

/* Stands right before each handle. */
struct facts {
  const char *names[2];
  const void *handles[2];
  const void *hash;
  const void *description;
  const void *sources;
  const struct functions *functions;
};

/* An operation is one of these with two operands; the words are in rn_interfaces/program.py. */
enum { END, NUMBERS, NUMBER_SEQUENCE, TEXT, ARRAY, SEQUENCE };

struct cursor {
  const unsigned char *data;
  uint64_t place;
  uint64_t end;
};

static bool skip(struct cursor *at, uint64_t alignment, uint64_t size)
{
  uint64_t gap = (0 - at->place) & (alignment - 1);
  if (gap + size > at->end - at->place) {
    return false;
  }
  at->place += gap + size;
  return true;
}

static uint32_t word(const unsigned char *data)
{
  return data[0] | (uint32_t)data[1] << 8 | (uint32_t)data[2] << 16 | (uint32_t)data[3] << 24;
}

static bool count(struct cursor *at, int64_t most, uint64_t *found)
{
  if (!skip(at, 4, 4)) {
    return false;
  }
  *found = word(at->data + at->place - 4);
  return *found <= (uint64_t)most;
}

static bool numbers(struct cursor *at, uint64_t size, uint64_t entries)
{
  return entries == 0 || skip(at, size, size * entries);
}

static bool text(struct cursor *at, int64_t unit, int64_t most)
{
  uint64_t entries;
  if (!count(at, INT64_MAX, &entries)) {
    return false;
  }
  const unsigned char *data = at->data + at->place;
  if (!skip(at, 1, entries * (uint64_t)unit)) {
    return false;
  }
  if (unit > 1) {
    for (uint64_t one = 0; one < entries; one++) {
      if (word(data + 4 * one) > UINT16_MAX) {
        return false;
      }
    }
    return entries <= (uint64_t)most;
  }
  if (entries <= (uint64_t)most) {
    return true;
  }
  uint64_t characters = 0; /* all bytes but those that continue one, and the zero at the end */
  for (uint64_t one = 0; one + 1 < entries; one++) {
    characters += (data[one] & 0xC0) != 0x80;
  }
  return characters <= (uint64_t)most;
}

static bool check(const int64_t *operation, struct cursor *at)
{
  for (; operation[0] != END; operation += 3) {
    uint64_t entries = (uint64_t)operation[1];
    bool good = true;
    if (operation[0] == NUMBERS) {
      good = numbers(at, (uint64_t)operation[1], (uint64_t)operation[2]);
    } else if (operation[0] == NUMBER_SEQUENCE) {
      good = count(at, operation[2], &entries) && numbers(at, (uint64_t)operation[1], entries);
    } else if (operation[0] == TEXT) {
      good = text(at, operation[1], operation[2]);
    } else {
      if (operation[0] == SEQUENCE) {
        /* an entry has one byte at least */
        good = count(at, operation[1], &entries) && entries <= at->end - at->place;
      }
      const int64_t *program = (const int64_t *)operation[2];
      for (uint64_t one = 0; good && one < entries; one++) {
        good = check(program, at);
      }
    }
    if (!good) {
      return false;
    }
  }
  return true;
}

static bool check_all(const int64_t *program, const unsigned char *data, size_t size)
{
  struct cursor at = {data, 0, size};
  return check(program, &at);
}

EXPORT bool is_valid(const int64_t *program, const unsigned char *data, size_t size)
{
  return check_all(program, data, size);
}

EXPORT bool serialize(const struct block *message, void *cdr)
{
  if (message->size > 0) {
    message->functions->write(cdr, message->data, message->size);
  }
  for (size_t one = 0; one < message->count; one++) {
    if (message->parts[one].size > 0) {
      message->functions->write(cdr, message->parts[one].data, message->parts[one].size);
    }
  }
  return true;
}

/* No function of Fast CDR says how long the rest is: the size stands in the buffer that a Cdr
 * refers to, after the pointers to its member functions.
 */
EXPORT bool deserialize(void *cdr, struct block *message)
{
  const struct functions *functions = message->functions;
  char **buffer = ((char ***)cdr)[14];
  char *memory = buffer[1];
  size_t size = (size_t)buffer[2];
  char *place = functions->place(cdr);
  if (memory != functions->begin(cdr) || place < memory + 4 || place > memory + size) {
    return false;
  }
  if (memory[0] != 0 || memory[1] != 1) { /* not plain CDR, little-endian */
    return false;
  }
  size_t left = (size_t)(memory + size - place);
  if (!check_all(message->program, (const unsigned char *)place, left)) {
    return false;
  }
  char *taken = functions->allocate(left + 1);
  if (taken == NULL) {
    return false;
  }
  functions->copy(taken, place, left);
  functions->release(message->taken);
  message->taken = taken;
  message->taken_size = left;
  return true;
}

EXPORT uint32_t size(const struct block *message)
{
  return (uint32_t)message->total;
}

EXPORT size_t max_size(char *bounds)
{
  *bounds = 0; /* unbounded */
  return 0;
}

static const struct facts *facts_of(const void *handle)
{
  return ((const struct facts *const *)handle)[-1];
}

EXPORT const void *get_handle(const void *handle, const char *name)
{
  const struct facts *facts = facts_of(handle);
  for (int one = 0; one < 2; one++) {
    if (facts->names[one] != NULL && facts->functions->compare(facts->names[one], name) == 0) {
      return facts->handles[one];
    }
  }
  return NULL;
}

EXPORT const void *get_hash(const void *handle)
{
  return facts_of(handle)->hash;
}

EXPORT const void *get_description(const void *handle)
{
  return facts_of(handle)->description;
}

EXPORT const void *get_sources(const void *handle)
{
  return facts_of(handle)->sources;
}
