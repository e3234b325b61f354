/* Scalar doubles: five bodies, Kepler's equation by bisection, and a linear system by elimination.
 *
 *     gcc -O2 -fno-tree-vectorize -Wl,-z,now -o bodies bodies.c -lm
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

enum { BODIES = 5, STEPS = 22000, SIZE = 90, ORBITS = 1500 };

struct body { double x, y, z, vx, vy, vz, mass; };

static struct body bodies[BODIES] = {
    {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 39.478417604357432},
    {4.8414314424647209, -1.1603200440274284, -0.10362204447112311,
     0.60632639299583202, 2.8119868449162602, -0.025218361659887629, 0.037693674870389493},
    {8.3433667182445799, 4.1247985641243048, -0.40352341711432138,
     -1.0107743461787924, 1.8256623712304119, 0.0084157613765841535, 0.011286326131968767},
    {12.894369562139131, -15.111151401698631, -0.22330757889265573,
     1.0827910064415354, 0.86871301816960822, -0.010832637401363636, 0.0017237240570597112},
    {15.379697114850917, -25.919314609987964, 0.17925877295037118,
     0.97909073224389798, 0.59469899864767617, -0.034755955550407810, 0.0020336868699246304},
};

static double matrix[SIZE][SIZE + 1], solution[SIZE];

static void advance(double dt) {
    for (int i = 0; i < BODIES; i++) {
        struct body *a = &bodies[i];
        for (int j = i + 1; j < BODIES; j++) {
            struct body *b = &bodies[j];
            double dx = a->x - b->x, dy = a->y - b->y, dz = a->z - b->z;
            double square = dx * dx + dy * dy + dz * dz;
            double pull = dt / (square * sqrt(square));
            a->vx -= dx * b->mass * pull;
            a->vy -= dy * b->mass * pull;
            a->vz -= dz * b->mass * pull;
            b->vx += dx * a->mass * pull;
            b->vy += dy * a->mass * pull;
            b->vz += dz * a->mass * pull;
        }
    }
    for (struct body *a = bodies; a != bodies + BODIES; a++) {
        a->x += dt * a->vx;
        a->y += dt * a->vy;
        a->z += dt * a->vz;
    }
}

static double energy(void) {
    double sum = 0.0;
    for (int i = 0; i < BODIES; i++) {
        const struct body *a = &bodies[i];
        sum += 0.5 * a->mass * (a->vx * a->vx + a->vy * a->vy + a->vz * a->vz);
        for (int j = i + 1; j < BODIES; j++) {
            const struct body *b = &bodies[j];
            double dx = a->x - b->x, dy = a->y - b->y, dz = a->z - b->z;
            sum -= a->mass * b->mass / sqrt(dx * dx + dy * dy + dz * dz);
        }
    }
    return sum;
}

/* The eccentric anomaly of an orbit from its mean anomaly, with a series for the sine. */
static double anomaly(double mean, double eccentricity) {
    double low = mean - eccentricity, high = mean + eccentricity;
    while (high - low > 1e-13) {
        double middle = 0.5 * (low + high), square = middle * middle, sine = 0.0;
        for (int term = 13; term >= 1; term -= 2)
            sine = 1.0 - square * sine / ((term + 1) * (term + 2));
        if (middle - eccentricity * middle * sine > mean) high = middle;
        else low = middle;
    }
    return low;
}

static void fill(void) {
    for (int i = 0; i < SIZE; i++) {
        for (int j = 0; j < SIZE; j++) matrix[i][j] = 1.0 / (1 + (i * 7 + j * 3) % 41);
        matrix[i][(i * 37 + 5) % SIZE] += 4.0;
        matrix[i][SIZE] = 1.0 + i % 3;
    }
}

static int solve(void) {
    for (int k = 0; k < SIZE; k++) {
        int best = k;
        for (int i = k + 1; i < SIZE; i++)
            if (fabs(matrix[i][k]) > fabs(matrix[best][k])) best = i;
        if (matrix[best][k] == 0.0) return 0;
        if (best != k)
            for (int j = k; j <= SIZE; j++) {
                double kept = matrix[k][j];
                matrix[k][j] = matrix[best][j];
                matrix[best][j] = kept;
            }
        for (int i = k + 1; i < SIZE; i++) {
            double factor = matrix[i][k] / matrix[k][k];
            if (factor == 0.0) continue;
            for (int j = k; j <= SIZE; j++) matrix[i][j] -= factor * matrix[k][j];
        }
    }
    for (int i = SIZE - 1; i >= 0; i--) {
        double rest = matrix[i][SIZE];
        for (int j = i + 1; j < SIZE; j++) rest -= matrix[i][j] * solution[j];
        solution[i] = rest / matrix[i][i];
    }
    return 1;
}

int main(void) {
    printf("energy %.9f\n", energy());
    for (int step = 0; step < STEPS; step++) advance(0.001);
    printf("energy %.9f, first body at %.9f %.9f %.9f\n", energy(), bodies[0].x, bodies[0].y,
           bodies[0].z);
    double anomalies = 0.0;
    for (int orbit = 0; orbit < ORBITS; orbit++)
        anomalies += anomaly(2.0 * orbit / ORBITS, 0.1 + 0.5 * (orbit % 7) / 7.0);
    printf("anomalies %.9f\n", anomalies);
    for (int round = 0; round < 2; round++) {
        fill();
        if (!solve()) {
            fprintf(stderr, "the system is singular\n");
            return 1;
        }
        double sum = 0.0, largest = 0.0;
        for (int i = 0; i < SIZE; i++) {
            sum += solution[i];
            if (fabs(solution[i]) > largest) largest = fabs(solution[i]);
        }
        printf("sum %.12f, largest %.12f\n", sum, largest);
    }
    return 0;
}
