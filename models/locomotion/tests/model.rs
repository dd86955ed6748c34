//! The models: named bodies, and one table that reads and sets every parameter.

use locomotion::model::{ANGLES, FACETS, Model, SETTINGS, Setting, Unsuitable, Value};
use locomotion::parameter::Label;
use locomotion::{folded, roller, tube};

fn set(model: &mut Model, key: &str, value: f64) {
    let setting = Setting::named(key).expect(key);
    model.set(setting, Value::Number(value)).expect(key);
}

/// The default model equals the parameters that rig and tube call the paper's, bit by bit.
#[test]
fn the_default_is_the_papers_rig_and_tube() {
    assert_eq!(Model::ONE.rig().unwrap(), roller::Params::PAPER);
    assert_eq!(Model::ONE.tube().unwrap(), tube::Params::PAPER);
    let folded = Model::ONE.folded(None).unwrap();
    let paper = folded::Params::PAPER;
    assert!((folded.width_mm - paper.width_mm).abs() < 1e-3);
    assert!((folded.length_mm - paper.length_mm).abs() < 1e-3);
    assert_eq!(
        (folded.tail_mm, folded.cycles),
        (paper.tail_mm, paper.cycles)
    );
}

#[test]
fn bodies_have_names() {
    for model in Model::ALL {
        assert_eq!(Model::named(model.name), Some(model));
        model.check().unwrap();
        assert_eq!(model.changes().count(), 0, "{}", model.name);
        assert!(!model.calibrated_to.is_empty());
    }
    assert_eq!(Model::named("two"), None);
    assert_eq!(Model::ALL[0], Model::ONE);
}

/// Each key is unique, has a meaning and a source, and sets the value that it reads and nothing else.
#[test]
fn each_parameter_sets_itself_and_no_other() {
    let mut keys: Vec<_> = Setting::all().map(|setting| setting.key).collect();
    keys.sort_unstable();
    keys.dedup();
    assert_eq!(keys.len(), SETTINGS.len() + ANGLES.len());
    for setting in &SETTINGS {
        assert!(!setting.meaning.is_empty());
        let mut model = Model::ONE;
        let before = setting.value(&model);
        // Whole numbers must stay whole.
        let wanted = before.mul_add(2.0, 1.0);
        set(&mut model, setting.key, wanted);
        assert_eq!(setting.value(&model), wanted, "{}", setting.key);
        let changed: Vec<_> = model.changes().map(|changed| changed.name).collect();
        assert_eq!(changed, [setting.key]);
        set(&mut model, setting.key, before);
        assert_eq!(model, Model::ONE, "{}", setting.key);
    }
    for row in Model::ONE.parameters() {
        assert!(
            !row.source.is_empty() && row.value.is_finite(),
            "{}",
            row.name
        );
        assert_ne!(row.label, Label::Given);
    }
    assert_eq!(Model::ONE.parameters().count(), SETTINGS.len());
}

/// Every parameter has an effect: it is refused out of its range, or changes the parameters of rig, tube or folded
/// body.
#[test]
fn each_parameter_reaches_its_world() {
    for setting in &SETTINGS {
        let mut model = Model::ONE;
        let before = setting.value(&model);
        set(
            &mut model,
            setting.key,
            if before == 0.0 {
                1.0
            } else {
                before + (before / 8.0).max(1e-4).ceil().min(before)
            },
        );
        let same = (model.rig(), model.tube(), model.folded(None))
            == (Model::ONE.rig(), Model::ONE.tube(), Model::ONE.folded(None));
        assert!(!same, "{}", setting.key);
    }
}

/// A value out of range is refused with its name, its range and its unit.
#[test]
fn a_value_out_of_range_is_refused() {
    for (key, value, says) in [
        ("design.width_mm", 0.0, "width W = 0 mm"),
        ("design.core_ratio", 1.0, "core ratio c/W = 1"),
        ("design.tan_alpha", 0.7, "above 0 and below 0.666"),
        ("design.crescents", 33.0, "from 1 to 32"),
        ("design.crescents", 300.0, "from 1 to 32"),
        ("body.coupling", 1.1, "coupling chi = 1.1 is not usable"),
        ("body.friction", 0.0, "friction coefficient = 0"),
        ("body.friction_ratio", 0.9, "from 1 to 1000000"),
        ("body.preload_mm", -0.1, "preload = -0.1 mm"),
        ("rig.tail_mm", f64::NAN, "start of the tail = NaN mm"),
        ("rig.stroke_mm", 0.0, "stroke = 0 mm"),
        ("rig.radius_mm", 9.0, "from 9.76 to 1000 mm"),
        ("rig.step_mm", 0.0, "roller step = 0 mm"),
        ("tube.placements", 0.0, "from 1 to 1000"),
        ("tube.segments", 1.0, "from 2 to 32"),
        ("tube.segment_mm", 0.0, "segment length = 0 mm"),
        ("tube.radius_mm", 0.0, "width W = 0 mm"),
        ("tube.thickness_mm", 0.0, "wall thickness = 0 mm"),
        ("tube.modulus_pa", -1.0, "Young's modulus = -1 Pa"),
        ("tube.poisson", 0.6, "from 0 to 0.5"),
        ("tube.critical_pa", 0.0, "critical pressure = 0 Pa"),
        ("tube.buckling_mm", -1.0, "buckling scale = -1 mm"),
        ("tube.pulse_s", 11.0, "pulse length = 11 s"),
        ("tube.delay_s", -1.0, "delay between segments = -1 s"),
        ("tube.period_s", 2.0, "pulse length = 3 s"),
        ("tube.duration_s", 0.0, "duration = 0 s"),
        ("tube.step_s", 0.0, "time step = 0 s"),
        ("tube.wall_step_mm", 0.0, "wall step = 0 mm"),
        ("folded.intestine_mm", 0.0, "intestine width D = 0 mm"),
        ("folded.thread_mm", 30.0, "thread travel = 30 mm"),
        ("folded.friction", -0.1, "friction coefficient = -0.1"),
        ("folded.tail_mm", 129.0, "start of the tail = 129 mm"),
    ] {
        let mut model = Model::ONE;
        set(&mut model, key, value);
        let why = model.check().expect_err(key).to_string();
        assert!(why.contains(says), "{key}: {why}");
    }
}

/// A short body has less than 21 mm of thread to draw in; only the run that needs the thread refuses it.
#[test]
fn a_short_body_is_a_model() {
    let mut model = Model::ONE;
    set(&mut model, "design.crescents", 5.0);
    model.check().unwrap();
    assert!(model.folded(None).is_err());
    assert!(model.folded(Some(12.0)).is_ok());
}

#[test]
fn what_no_parameter_can_be_is_refused_at_once() {
    let mut model = Model::ONE;
    let mut refuse = |key: &str, value| model.set(Setting::named(key).unwrap(), value).unwrap_err();
    for part in [9.5, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(
            refuse("design.crescents", Value::Number(part)),
            Unsuitable::NotWhole(_)
        ));
    }
    assert_eq!(
        refuse("body.coupling", Value::Word("much")),
        Unsuitable::NotNumber
    );
    assert_eq!(
        refuse("body.coupling", Value::Word(FACETS)),
        Unsuitable::NotNumber
    );
    assert_eq!(
        refuse("body.friction_ratio", Value::Word("much")),
        Unsuitable::NotRatio
    );
    for deg in [0.0, 90.0, -5.0, f64::NAN] {
        let why = refuse("design.beta_deg", Value::Number(deg)).to_string();
        assert!(why.contains("above 0 and below 90 deg"), "{why}");
    }
    assert_eq!(model, Model::ONE);
}

#[test]
fn an_angle_is_another_way_to_give_its_tangent() {
    let mut model = Model::ONE;
    set(&mut model, "design.beta_deg", 45.0);
    let slope = Setting::named("design.tan_beta").unwrap();
    assert!((slope.value(&model) - 1.0).abs() < 1e-15);
    for angle in &ANGLES {
        let other = Setting::named(angle.other_key().unwrap()).unwrap();
        assert_eq!(other.other_key(), Some(angle.key));
    }
    assert_eq!(Setting::named("body.coupling").unwrap().other_key(), None);
}

/// The friction ratio of the facets is read at the present friction, and is shown by its word.
#[test]
fn facets_follow_the_friction() {
    let ratio = Setting::named("body.friction_ratio").unwrap();
    assert_eq!(ratio.word(&Model::TUBE), Some(FACETS));
    assert_eq!(ratio.word(&Model::ONE), None);
    // 1.1/0.9 at mu = 0.15 and tan beta = 2/3.
    assert!((ratio.value(&Model::TUBE) - 1.1 / 0.9).abs() < 1e-12);
    let mut model = Model::TUBE;
    set(&mut model, "body.friction", 0.3);
    assert!((ratio.value(&model) - 1.5).abs() < 1e-12);
    let mut model = Model::ONE;
    model.set(ratio, Value::Word(FACETS)).unwrap();
    let changed: Vec<_> = model.changes().collect();
    assert_eq!((changed.len(), changed[0].word), (1, Some(FACETS)));
}
