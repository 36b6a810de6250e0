"""The table of experiments/particles.py says what more particles bought, and what they did not."""

import particles


def rows(count, errors, evidence, case="woods known"):
    return [
        dict(case=case, particles=count, seed=seed, frames=50, seconds=5.0, log_evidence=nats,
             ate_filtered_rmse_m=error, landmark_filtered_rmse_m=error / 2)
        for seed, (error, nats) in enumerate(zip(errors, evidence, strict=True))
    ]  # fmt: skip


def test_a_difference_counts_from_two_standard_errors_and_evidence_is_better_when_higher():
    few = rows(1000, [0.10, 0.12, 0.11], [90.0, 95.0, 100.0])
    many = rows(10_000, [0.05, 0.06, 0.055], [96.0, 95.0, 97.0])
    assert particles.bought(few, many, "ate_filtered_rmse_m").startswith("better (-0.055")
    assert particles.bought(many, few, "ate_filtered_rmse_m").startswith("worse")
    assert particles.bought(few, many, "log_evidence").startswith("nothing seen")
    better = rows(10_000, [0.1] * 3, [120.0, 121.0, 122.0])
    assert particles.bought(few, better, "log_evidence").startswith("better")
    assert particles.bought(few, many[:1], "log_evidence") == "too few seeds to tell"


def test_the_table_and_the_figure(tmp_path):
    found = rows(1000, [0.10, 0.12, 0.11], [90.0, 95.0, 100.0])
    found += rows(10_000, [0.05, 0.06, 0.055], [96.0, 95.0, 97.0])
    text = particles.text(found)
    assert (
        "| 1,000 | 3 | 50 | 0.110 (0.100-0.120) | 0.055 (0.050-0.060) | 95.0 | 5.00 | 0.1 |" in text
    )
    assert "known, 1,000 to 10,000: filtered path better (-0.055" in text
    particles.draw(found, tmp_path / "particles.png")
    assert (tmp_path / "particles.png").stat().st_size > 10_000


def test_the_cases_are_cuts_of_the_real_log():
    log, settings, _ = particles.log_of("woods hidden")
    assert settings["association"] == "maximum_likelihood"
    assert len(log.frame_time) == particles.SECONDS / particles.SPACING + 1
