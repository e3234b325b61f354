/* Integers: quicksort, hash table, binary search, divisors and CRC-32 of pseudo-random keys.
 *
 *     gcc -O2 -Wl,-z,now -o sorting sorting.c
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

enum { KEYS = 12000, SLOTS = 1 << 15, LOOKUPS = 24000 };

static uint32_t keys[KEYS], table[256];
static struct slot { uint32_t key, count; } slots[SLOTS];

static uint32_t next_random(uint32_t *state) {
    uint32_t x = *state;
    x ^= x << 13;
    x ^= x >> 17;
    x ^= x << 5;
    return *state = x;
}

static void insertion_sort(uint32_t *low, uint32_t *high) {
    for (uint32_t *next = low + 1; next <= high; next++) {
        uint32_t key = *next, *place = next;
        for (; place > low && place[-1] > key; place--) *place = place[-1];
        *place = key;
    }
}

static void sort(uint32_t *low, uint32_t *high) {
    while (high - low > 12) {
        uint32_t pivot = low[(high - low) / 2], *left = low, *right = high;
        while (left <= right) {
            while (*left < pivot) left++;
            while (*right > pivot) right--;
            if (left <= right) {
                uint32_t kept = *left;
                *left++ = *right;
                *right-- = kept;
            }
        }
        sort(low, right);
        low = left;
    }
    insertion_sort(low, high);
}

static struct slot *find_slot(uint32_t key) {
    uint32_t index = key * 2654435761u >> 17;
    while (slots[index].count != 0 && slots[index].key != key) index = (index + 1) % SLOTS;
    return &slots[index];
}

static int search(uint32_t key) {
    int low = 0, high = KEYS - 1;
    while (low <= high) {
        int middle = low + (high - low) / 2;
        if (keys[middle] == key) return middle;
        if (keys[middle] < key) low = middle + 1;
        else high = middle - 1;
    }
    return -1;
}

static uint64_t common_divisor(uint64_t a, uint64_t b) {
    while (a != b) {
        if (a > b) a -= b;
        else b -= a;
    }
    return a;
}

static void make_table(void) {
    for (uint32_t byte = 0; byte < 256; byte++) {
        uint32_t rest = byte;
        for (int bit = 0; bit < 8; bit++) rest = rest & 1 ? rest >> 1 ^ 0xedb88320u : rest >> 1;
        table[byte] = rest;
    }
}

static uint32_t crc(const unsigned char *bytes, size_t length) {
    uint32_t rest = 0xffffffffu;
    while (length--) rest = table[(rest ^ *bytes++) & 0xff] ^ rest >> 8;
    return ~rest;
}

int main(void) {
    uint32_t state = 2463534242u, distinct = 0, hits = 0;
    uint64_t places = 0, divisors = 0;
    make_table();
    for (int round = 0; round < 3; round++) {
        for (int i = 0; i < KEYS; i++) keys[i] = next_random(&state) % 30011u;
        sort(keys, keys + KEYS - 1);
        for (int i = 0; i < KEYS; i++) {
            struct slot *slot = find_slot(keys[i]);
            if (slot->count == 0) distinct++;
            slot->key = keys[i];
            slot->count = slot->count + 1;
        }
        for (int i = 0; i < LOOKUPS; i++) {
            int place = search(next_random(&state) % 30011u);
            if (place < 0) continue;
            hits = hits + 1;
            places = places + (uint64_t) place;
            if (hits % 16 == 0) divisors = divisors + common_divisor(keys[place] + 1, hits);
        }
        printf("round %d: crc %08" PRIx32 ", first %" PRIu32 ", last %" PRIu32 "\n", round,
               crc((const unsigned char *) keys, sizeof keys), keys[0], keys[KEYS - 1]);
    }
    printf("distinct %" PRIu32 ", hits %" PRIu32 ", places %" PRIu64 ", divisors %" PRIu64 ", table %08" PRIx32 "\n",
           distinct, hits, places, divisors,
           crc((const unsigned char *) slots, sizeof slots));
    return 0;
}
