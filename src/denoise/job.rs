//! One frame in three steps: load, denoise, store. A batch overlaps the steps of different frames.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
    time::Instant,
};

use super::{
    lights::{Along, Alpha, Source, denoised_lights, light_passes, passes_along},
    plan::are_same,
    window,
    wrap::{self, Wrap},
};
use crate::{
    Error, Result,
    companion::Companion,
    frame::{Frame, NewChannel, Recoded, SampleKind, UNSTORABLE},
    models::{Denoiser, ExpectedError, check_expects, without_variant},
    passes::{
        self, COMBINED, COMPOSITE, Layer, NOISY_IMAGE, Pass, PassChannels, PassSet, is_bare, light_group,
    },
    planes::Planes,
    shot::{self, Shot},
    sources::Sources,
};

/// One file to denoise.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Job {
    /// The render.
    pub input: PathBuf,
    /// The result.
    pub output: PathBuf,
}

/// Writes radiance (3, H, W) as a picture: `preview::write`, where the feature `preview` is on.
pub type WritePicture = fn(&Path, &Planes) -> Result<()>;

/// What is chosen for every frame of a batch.
#[derive(Clone, Debug)]
pub struct Options {
    /// The view layer to denoise; without it the one with the most passes.
    pub view_layer: Option<String>,
    /// The layer to add, see [`check_layer_name`]; none where the beauty is replaced.
    pub layer: Option<String>,
    /// Rows (and columns, where a model works on tiles) that are worked on at once, to bound memory.
    pub tile: Option<usize>,
    /// Writes a picture beside each result.
    pub preview: Option<WritePicture>,
    /// Whether a [`super::Batch`] denoises again what is finished.
    pub overwrite: bool,
    /// How many frames before one, and after it, a [`super::Batch`] uses to make it better and steadier; none
    /// for frame by frame.
    pub temporal: Option<usize>,
    /// What becomes of alpha.
    pub alpha: Alpha,
    /// Where passes are that cannot be found by their names.
    pub sources: Sources,
    /// Whether light passes and light groups are denoised as well, so that they add up to the denoised
    /// beauty.
    pub passes: bool,
    /// Whether the left and the right edge of a frame meet.
    pub wrap: Wrap,
    /// Whether a layer is added that tells how far off each pixel is expected to be.
    pub confidence: bool,
}

impl Default for Options {
    /// Adds the layer `Denoised` to the view layer with the most passes.
    fn default() -> Self {
        Self {
            view_layer: None,
            layer: Some("Denoised".into()),
            tile: None,
            preview: None,
            overwrite: false,
            temporal: None,
            alpha: Alpha::Auto,
            sources: Sources::default(),
            passes: false,
            wrap: Wrap::Auto,
            confidence: false,
        }
    }
}

impl Options {
    /// How a result is made: by which version, and the options that decide what is in it and that nothing else in the
    /// file tells, as they are said on the command line. Guides go by their names, wherever they lie, and weights by
    /// that of their folder too, since every run's are called alike.
    fn method(&self, model: &dyn Denoiser) -> String {
        let name = |path: &Path| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let file = Path::new(without_variant(model.name()));
        let weights = file.extension().and_then(|_| {
            let (place, variant) = (file.canonicalize().ok()?, &model.name()[file.as_os_str().len()..]);
            Some(format!("{}/{}{variant}", name(place.parent()?), name(&place)))
        });
        let model = weights.as_deref().unwrap_or(model.name());
        let mut said = vec![format!("demc {} --model {model}", env!("CARGO_PKG_VERSION"))];
        said.extend(option("--alpha", Alpha::ALL, self.alpha));
        said.extend(option("--wrap", Wrap::ALL, self.wrap));
        said.extend(self.temporal.map(|reach| format!("--temporal {reach}")));
        let Sources { mapping, albedo, normal } = &self.sources;
        said.extend(mapping.iter().map(|(pass, name)| format!("--map '{pass}={name}'")));
        for (option, pattern) in [("--albedo", albedo), ("--normal", normal)] {
            said.extend(pattern.as_ref().map(|pattern| format!("{option} '{}'", name(pattern))));
        }
        said.join(" ")
    }
}

/// How a choice among `all` is said on the command line; the first goes without saying.
fn option<T: Copy + PartialEq>(name: &str, all: [(&str, T); 3], chosen: T) -> Option<String> {
    all.into_iter().skip(1).find(|(_, how)| *how == chosen).map(|(how, _)| format!("{name} {how}"))
}

/// Whether a name can be a layer's: it must make channel names that read back as this layer and no other.
///
/// # Errors
/// Why it cannot.
pub fn check_layer_name(name: &str) -> Result<(), &'static str> {
    let reserved = |p: &Pass| p.to_string() == name || p.blender_names().contains(&name);
    if name.is_empty() || name.chars().count() > 100 || name.contains(|c: char| c == '.' || c.is_control()) {
        Err("wants 1 to 100 characters in one line, without a dot")
    } else if name == NOISY_IMAGE
        || light_group(name).is_some()
        || is_bare(name)
        || Pass::ALL.iter().any(reserved)
    {
        Err("is a pass of the renderer; choose another name, or --replace for Combined")
    } else {
        Ok(())
    }
}

/// What the user is told of a frame that was denoised.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// The view layer denoised.
    pub view_layer: String,
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The passes of the view layer that demc knows, by name.
    pub passes: Vec<String>,
    /// Its light groups.
    pub light_groups: Vec<String>,
    /// Samples of a pixel, or the most that it may have had, where the file tells.
    pub samples: Option<u32>,
    /// Whether Blender had denoised Combined, so that its Noisy Image was denoised instead.
    pub was_denoised: bool,
    /// The expected RelMSE of the result, as the mean over its views, where the model can tell.
    pub expected_error: Option<f64>,
    /// How it was made, in words of the command line, beyond what the file shows otherwise.
    pub method: String,
    /// Seconds in the model alone.
    pub seconds: f64,
    /// How many NaN and infinite input values were repaired, by pass.
    pub repaired: BTreeMap<String, usize>,
    /// What the user should know.
    pub notes: Vec<String>,
    /// Frames of its window, by number, that it was made without since they were not there, or could not be read.
    pub lacked: BTreeSet<i64>,
}

/// A frame and, for each of its stereo views, where the view's beauty is and what `T` holds of the view.
pub struct Views<T> {
    frame: Frame,
    views: Vec<(Layer, T)>,
    report: Report,
}

/// Reads a frame and decodes the passes the model needs.
///
/// # Errors
/// The file is unusable, lacks a pass that the model needs, or holds a layer of the new one's name that is
/// not demc's.
pub fn load(input: &Path, model: &dyn Denoiser, options: &Options) -> Result<Views<Shot>> {
    check_options(model, options)?;
    take_apart(Frame::read(input)?, model, options)
}

/// As [`load`], from a frame that has been read.
///
/// # Errors
/// As [`load`], except that the frame's own file is not read.
pub(super) fn take_apart(frame: Frame, model: &dyn Denoiser, options: &Options) -> Result<Views<Shot>> {
    check_options(model, options)?;
    let input = frame.path();
    let layers = passes::layers_by(&frame, &options.sources.mapping);
    let chosen = passes::choose(&frame, &layers, options.view_layer.as_deref())?;
    let mut report = Report {
        view_layer: chosen.name.clone(),
        passes: chosen.passes.keys().map(Pass::to_string).collect(),
        light_groups: chosen.light_groups.keys().cloned().collect(),
        method: options.method(model),
        ..Report::default()
    };
    if options.view_layer.is_none() {
        report.notes.extend(note_other_layers(&layers, chosen));
    }
    if options.layer.is_none() {
        report.notes.extend(note_other_pictures(&layers, chosen));
    }
    // Besides its stereo views, a view layer may hold channels that belong to no view.
    let has_beauty = |layer: &&Layer| layer.passes.contains_key(&Pass::Combined);
    let eyes: Vec<&Layer> = layers.iter().filter(|l| l.name == chosen.name).filter(has_beauty).collect();
    let Some(first) = eyes.first() else {
        return Err(Error::MissingPass {
            path: input.into(),
            view_layer: chosen.name.clone(),
            renderer: chosen.renderer,
            passes: vec![Pass::Combined],
            needed_by: model.name().into(),
        });
    };
    check_added(&frame, first, options)?;
    let mut needed = vec![Pass::Combined];
    needed.extend(model.passes().iter().filter(|pass| **pass != Pass::Combined));
    let of_motion = if options.temporal.is_some() { &window::PASSES[..] } else { &[] };
    let lights = if options.passes { light_passes() } else { Vec::new() };
    let wanted = [&needed, model.optional_passes(), &[Pass::Alpha], of_motion, &lights].concat();
    let mut views = Vec::new();
    for layer in eyes {
        refuse_stale(&frame, layer, options)?;
        options.sources.mapping.check(input, layer)?;
        let mut shot = shot::prepare_layer(&frame, layer, &wanted, &options.sources)?;
        shot.wraps = options.wrap.of(&frame, layer.passes[&Pass::Combined].part);
        if options.wrap == Wrap::X && !shot.wraps {
            let why = "the data window is not as wide as the display window, so that its edges do not meet (--wrap x)";
            report.notes.push(why.into());
        }
        report.notes.extend(shot.normals.take());
        report.samples = shot.passes.samples;
        report.was_denoised |= shot.was_denoised;
        if shot.was_denoised {
            report.notes.push(
                "Combined was already denoised by Blender; its Noisy Image pass is used instead".into(),
            );
        }
        let beauty = layer_name(&layer.name, &layer.passes[&Pass::Combined].name);
        if frame.is_own_layer(&beauty) && !shot.was_denoised {
            report
                .notes
                .push("Combined was already denoised by demc (--replace), and is denoised once more".into());
            let is_own = |at: &PassChannels| frame.is_own_layer(&layer_name(&layer.name, &at.name));
            let lights = denoised_lights(layer);
            if options.passes && !lights.is_empty() && !lights.into_iter().any(is_own) {
                let why = "its light passes are as rendered: they do not add up to it, and their results do not either";
                report.notes.push(why.into());
            }
        }
        shot.refuse_broken()?;
        // Before any work: a missing pass is the user's commonest mistake.
        model.check(&shot.passes)?;
        let is_given = options.sources.normal.is_some();
        if needed.contains(&Pass::Normal) && !is_given && !layer.passes.contains_key(&Pass::Normal) {
            report.notes.push("Normal is missing; Denoising Normal, of camera space, took its place".into());
        }
        if model.reads_halves() {
            shot.read_halves()?;
        }
        if options.passes {
            shot.read_light_groups(&frame, layer)?;
        }
        let of_passes = shot.repaired.iter().map(|(pass, count)| (pass.to_string(), count));
        let of_groups = shot.repaired_groups.iter().map(|(group, count)| (group.clone(), count));
        for (name, count) in of_passes.chain(of_groups) {
            *report.repaired.entry(name).or_default() += count;
        }
        (report.width, report.height) = (shot.passes.width, shot.passes.height);
        views.push((layer.clone(), shot));
    }
    report.notes.dedup(); // stereo views repeat them
    Ok(Views { frame, views, report })
}

/// Refuses to replace a result whose light passes would stay, as they add up to that result alone.
fn refuse_stale(frame: &Frame, layer: &Layer, options: &Options) -> Result<()> {
    if options.passes {
        return Ok(());
    }
    let mut names = denoised_lights(layer).into_iter().map(|at| result_name(layer, at, options));
    let Some(name) = names.find(|name| frame.is_own_layer(name)) else { return Ok(()) };
    let why = format!(
        "holds '{name}', which belongs to the result that would be replaced; say --passes, or --layer NAME for one beside it"
    );
    Err(Error::invalid(frame.path(), why))
}

/// Refuses layers to add whose names are no layer's, or those of others.
fn check_added(frame: &Frame, layer: &Layer, options: &Options) -> Result<()> {
    check_name(options)?;
    let mut names = Vec::new();
    if let Some(added) = &options.layer {
        names.push(added_name(layer, COMBINED, added));
        let along = if options.passes { passes_along(layer) } else { Vec::new() };
        names.extend(along.into_iter().map(|at| added_name(layer, &at.name, added)));
    }
    if options.passes && options.layer.is_none() {
        let mut along = passes_along(layer).into_iter();
        if let Some(other) = along.find(|at| !has_window_of_beauty(frame, layer, at)) {
            let why = format!(
                "'{}' is stored for other pixels than the beauty, so that nothing can take its place; leave out --replace",
                layer_name(&layer.name, &other.name)
            );
            return Err(Error::invalid(frame.path(), why));
        }
    }
    names.extend(options.confidence.then(|| layer_name(&layer.name, &error_layer(options))));
    for name in names {
        if frame.has_foreign_layer(&name) {
            let why = format!("holds a layer '{name}' without demc's mark; give --layer another name");
            return Err(Error::invalid(frame.path(), why));
        }
        if name.contains(UNSTORABLE) {
            let why = format!("a layer cannot be called {name:?}; give the view layer another name");
            return Err(Error::invalid(frame.path(), why));
        }
    }
    Ok(())
}

fn check_name(options: &Options) -> Result<()> {
    let Some(name) = options.layer.as_deref() else { return Ok(()) };
    check_layer_name(name).map_err(|why| Error::Usage(format!("layer '{name}': {why}")))
}

/// Refuses options that the model cannot meet or that exclude each other, before anything is read. Loading a
/// frame does the same.
///
/// # Errors
/// Which they are.
pub fn check_options(model: &dyn Denoiser, options: &Options) -> Result<()> {
    let wrong = |why: String| Err(Error::Usage(why));
    check_name(options)?;
    if options.tile == Some(0) {
        return wrong("tiles of no pixels; give their side, or leave it out".into());
    }
    if options.temporal.is_some_and(|reach| reach > u8::MAX.into()) {
        return wrong("frames on each side: at most 255".into());
    }
    let along = [("--passes", options.passes), ("--alpha denoise", options.alpha == Alpha::Denoise)];
    if let Some((option, _)) = along.iter().find(|(_, is_on)| *is_on && !model.takes_companions()) {
        let name = model.name();
        return wrong(format!("{name} denoises the beauty alone; {option} takes demc-s, demc-m or demc-l"));
    }
    if options.confidence {
        check_expects(model, "--confidence")?;
    }
    if options.temporal.is_some() && (options.passes || options.confidence) {
        return wrong("--passes and --confidence work frame by frame; leave out --temporal, or them".into());
    }
    Ok(())
}

/// Other view layers are told of. What the compositor made is none.
fn note_other_layers(layers: &[Layer], chosen: &Layer) -> Option<String> {
    let mut others: Vec<String> = layers
        .iter()
        .filter(|l| {
            ![&chosen.name[..], COMPOSITE].contains(&l.name.as_str())
                && l.passes.contains_key(&Pass::Combined)
        })
        .map(|l| format!("'{}'", l.name))
        .collect();
    others.dedup();
    (!others.is_empty()).then(|| {
        format!("denoised view layer '{}'; --view-layer chooses another: {}", chosen.name, others.join(", "))
    })
}

/// Where the beauty is replaced, pictures in the file that were made of the noisy one are told.
fn note_other_pictures(layers: &[Layer], chosen: &Layer) -> Option<String> {
    let is_picture = |layer: &&Layer| {
        let is_shown = layer.name == COMPOSITE || (layer.name.is_empty() && !chosen.name.is_empty());
        is_shown && layer.name != chosen.name && layer.passes.contains_key(&Pass::Combined)
    };
    let shown = layers.iter().find(is_picture)?;
    let what =
        if shown.name.is_empty() { "R, G, B without a layer".into() } else { format!("'{}'", shown.name) };
    Some(format!(
        "{what}, which other programs show first, was made of the noisy picture and stays as it is: render without \
         compositing, or composite again from the result"
    ))
}

/// Denoised radiance, and what goes with it.
pub struct Denoised {
    radiance: Planes,
    alpha: Option<Planes>,
    lights: Vec<(Source, Planes)>,
    error: Option<ExpectedError>,
}

/// Runs the model over each view.
///
/// # Errors
/// The model cannot denoise the frame.
pub fn denoise(loaded: Views<Shot>, model: &dyn Denoiser, options: &Options) -> Result<Views<Denoised>> {
    // This runs on one of rayon's threads. From outside, each of a network's hundreds of steps would first
    // have to wake them up.
    rayon::scope(|_| denoise_here(loaded, model, options))
}

fn denoise_here(loaded: Views<Shot>, model: &dyn Denoiser, options: &Options) -> Result<Views<Denoised>> {
    loaded.each(|frame, layer, mut shot, report| {
        let mut along = Along::take(&mut shot, model, options, &mut report.notes);
        report.notes.extend(model.notes(&shot).filter(|note| !report.notes.contains(note)));
        let start = Instant::now();
        let (radiance, error) = run(&shot, &mut along.companions, true, (model, options.tile))?;
        let (path, alpha) = (shot.passes.path.clone(), shot.passes.remove(Pass::Alpha));
        // What was read is not needed after that, so its memory is freed.
        along.denoise_apart(shot, (model, options.tile))?;
        report.seconds += start.elapsed().as_secs_f64();
        let (denoised_alpha, lights) = along.finish(frame, layer);
        let done = finish(&path, radiance, (denoised_alpha.or(alpha), lights), model, report)?;
        Ok(Denoised { error, ..done })
    })
}

/// Denoises passes that are in memory, by the same steps as a file's. Returns finite radiance, (3, H, W), and alpha, (1,
/// H, W), where the shot has that. Of the options, `tile` and `alpha` count; whether edges meet is the shot's to say.
///
/// # Errors
/// A pass is missing, most of the beauty is not finite, the model cannot denoise the frame, or options ask for more than
/// a beauty.
pub fn shot(mut shot: Shot, model: &dyn Denoiser, options: &Options) -> Result<(Planes, Option<Planes>)> {
    model.check(&shot.passes)?;
    check_options(model, options)?;
    if options.passes || options.confidence || options.temporal.is_some() {
        let why = "of a shot in memory the beauty is denoised and its alpha: passes, confidence and temporal are for files";
        return Err(Error::Usage(why.into()));
    }
    if shot.passes.width * shot.passes.height == 0 {
        return Err(Error::invalid(&shot.passes.path, "has no pixels"));
    }
    shot.refuse_broken()?;
    let mut report = Report::default();
    rayon::scope(|_| {
        let mut along = Along::take(&mut shot, model, options, &mut report.notes);
        let (radiance, _) = run(&shot, &mut along.companions, false, (model, options.tile))?;
        let radiance = finite(radiance, model.name(), &shot.passes.path, &mut report)?;
        let alpha = shot.passes.remove(Pass::Alpha);
        along.denoise_apart(shot, (model, options.tile))?;
        Ok((radiance, along.alpha().or(alpha)))
    })
}

impl<T> Views<T> {
    /// Adds a note for the user.
    pub(super) fn say(&mut self, note: &str) {
        self.report.notes.push(note.into());
    }

    /// Replaces what `T` holds of every view by what `change` makes of it.
    ///
    /// # Errors
    /// The first error of `change`.
    pub(super) fn each<U>(
        self,
        mut change: impl FnMut(&Frame, &Layer, T, &mut Report) -> Result<U>,
    ) -> Result<Views<U>> {
        let Self { frame, views, mut report } = self;
        let mut done = Vec::with_capacity(views.len());
        for (layer, view) in views {
            let view = change(&frame, &layer, view, &mut report)?;
            done.push((layer, view));
        }
        report.notes.dedup(); // stereo views repeat them
        Ok(Views { frame, views: done, report })
    }
}

/// Runs the model over a view. Companions are denoised in place; if the caller `expects` it, how far off the result is
/// expected to be is returned.
///
/// # Errors
/// The model cannot denoise it.
pub(super) fn run(
    shot: &Shot,
    companions: &mut [Companion],
    expects: bool,
    (model, tile): (&dyn Denoiser, Option<usize>),
) -> Result<(Planes, Option<ExpectedError>)> {
    let denoise =
        |shot: &Shot, companions: &mut [Companion]| model.denoise_along(shot, companions, tile, expects);
    let (radiance, error) =
        if shot.wraps { wrap::joined(shot, companions, denoise)? } else { denoise(shot, companions)? };
    let size = (shot.passes.width, shot.passes.height);
    if (radiance.channels, (radiance.width, radiance.height)) != (3, size) {
        return Err(Error::invalid(
            &shot.passes.path,
            format!("model {} returned an image of the wrong size; choose another model", model.name()),
        ));
    }
    Ok((radiance, error))
}

/// What is stored of a view: radiance, alpha and light passes. Values of radiance and light passes that are
/// not finite are filled in.
///
/// # Errors
/// Most values of one of them are not finite.
pub(super) fn finish(
    path: &Path,
    radiance: Planes,
    (alpha, lights): (Option<Planes>, Vec<(Source, Planes)>),
    model: &dyn Denoiser,
    report: &mut Report,
) -> Result<Denoised> {
    let mut useful = |planes| finite(planes, model.name(), path, report);
    let radiance = useful(radiance)?;
    let lights = lights.into_iter().map(|(source, light)| Ok((source, useful(light)?)));
    let lights = lights.collect::<Result<_>>()?;
    Ok(Denoised { radiance, alpha, lights, error: None })
}

/// What a model returned, with values that are not finite filled in from around them.
///
/// # Errors
/// Most values are not finite, so that what is around them is no picture.
fn finite(radiance: Planes, model: &str, input: &Path, report: &mut Report) -> Result<Planes> {
    let values = radiance.data.len();
    let mut set = PassSet::new(PathBuf::new(), "", radiance.width, radiance.height);
    set.insert(Pass::Combined, radiance);
    match set.sanitize().get(&Pass::Combined) {
        Some(&count) if count > values / 2 => {
            let why = format!("model {model} returned {count} of {values} values that are NaN or infinite");
            return Err(Error::invalid(input, format!("{why}; check the frame, or choose another model")));
        }
        Some(count) => report
            .notes
            .push(format!("the model returned {count} non-finite values; they were filled from around them")),
        None => {}
    }
    Ok(set.remove(Pass::Combined).expect("inserted above"))
}

/// The full name of a layer of a view layer.
fn layer_name(view_layer: &str, name: &str) -> String {
    if view_layer.is_empty() { name.into() } else { format!("{view_layer}.{name}") }
}

/// Adds the layers, or replaces the beauty, and writes the file.
///
/// # Errors
/// The result does not fit into the file's format, or cannot be written.
pub fn store(denoised: Views<Denoised>, output: &Path, options: &Options) -> Result<Report> {
    let (frame, report) = insert(denoised, output, options)?;
    // The EXR is written last, so that one that exists is a finished frame.
    frame.write(output)?;
    Ok(report)
}

/// Adds the layers, or replaces the beauty, and writes the preview: all but the file itself.
///
/// # Errors
/// As [`store`].
pub(super) fn insert(denoised: Views<Denoised>, output: &Path, options: &Options) -> Result<(Frame, Report)> {
    let Views { mut frame, views, mut report } = denoised;
    for (layer, _) in &views {
        check_added(&frame, layer, options)?;
    }
    // A pattern that leads to no file is told where it is read.
    let mut guides = options.sources.guides(frame.path()).unwrap_or_default().into_iter();
    if let Some(guide) = guides.find(|guide| are_same(guide, output)) {
        let why = "is a guide of this frame, which the result would overwrite; choose another --out";
        return Err(Error::invalid(guide, why));
    }
    if are_same(frame.path(), output) {
        return Err(Error::invalid(
            output,
            "is the render, which the result would overwrite; choose another place",
        ));
    }
    report.expected_error = mean(views.iter().map(|(_, view)| view.error.as_ref().map(ExpectedError::mean)));
    for (layer, Denoised { radiance, alpha, lights, error }) in &views {
        let beauty = (&layer.passes[&Pass::Combined], COMBINED, radiance, alpha.as_ref());
        let lights = lights.iter().map(|(source, light)| {
            let at = source.channels(layer);
            (at, at.name.as_str(), light, None)
        });
        for (at, pass, planes, alpha) in std::iter::once(beauty).chain(lights) {
            if let Some(recoded) = put(&mut frame, layer, (at, pass), (planes, alpha), options)? {
                let part = frame.parts()[at.part].name.clone();
                let what = part.map_or("all channels".into(), |n| format!("part '{n}'"));
                report.notes.push(format!("{what}: {recoded}"));
            }
        }
        let result = layer_name(&layer.name, options.layer.as_deref().unwrap_or(&beauty.0.name));
        frame.set_expected_error(&result, layer.view.as_deref(), error.as_ref().map(ExpectedError::mean));
        frame.set_lacked(&result, &report.lacked);
        frame.set_reach(&result, options.temporal.unwrap_or(0));
        frame.set_method(&result, &report.method);
        let name = layer_name(&layer.name, &error_layer(options));
        // Such a layer of an earlier result would not be true of this one, so it is replaced, by numbers that are
        // none where nothing is known.
        if options.confidence || frame.is_own_layer(&name) {
            let unknown = || {
                Planes::from_vec(1, radiance.width, radiance.height, vec![f32::NAN; radiance.data.len() / 3])
            };
            let values = error.as_ref().map_or_else(unknown, ExpectedError::plane);
            let channel = NewChannel { component: "X", kind: SampleKind::Float, values: values.channel(0) };
            frame.set_layer(beauty.0.part, &name, layer.view.as_deref(), &[channel])?;
        }
    }
    report.notes.dedup();
    for (layer, Denoised { radiance, .. }) in &views {
        let path = preview_path(output, layer, views.len());
        if let Some(write) = options.preview {
            if options.overwrite || !path.exists() {
                write(&path, radiance)?;
            } else {
                report.notes.push(format!("{}: kept; --overwrite writes it anew", path.display()));
            }
        } else if path.exists() && output.exists() {
            let why = format!("{}: may show the earlier result; --preview writes it anew", path.display());
            report.notes.push(why);
        }
    }
    Ok((frame, report))
}

/// Adds a denoised pass as a layer, or replaces it.
fn put(
    frame: &mut Frame,
    layer: &Layer,
    (at, pass): (&PassChannels, &str),
    (planes, alpha): (&Planes, Option<&Planes>),
    options: &Options,
) -> Result<Option<Recoded>> {
    if let Some(added) = &options.layer {
        let kind = match frame.parts()[at.part].channels[at.channels[0]].kind {
            SampleKind::Uint => SampleKind::Float, // light is no whole number
            kind => kind,
        };
        let beside = if has_window_of_beauty(frame, layer, at) { at } else { &layer.passes[&Pass::Combined] };
        let mut channels: Vec<NewChannel<'_>> = ["R", "G", "B"]
            .iter()
            .enumerate()
            .map(|(c, component)| NewChannel { component, kind, values: planes.channel(c) })
            .collect();
        if let Some(alpha) = alpha {
            channels.push(NewChannel { component: "A", kind, values: alpha.channel(0) });
        }
        let name = added_name(layer, pass, added);
        return frame.set_layer(beside.part, &name, layer.view.as_deref(), &channels);
    }
    let mut channels: Vec<(usize, &[f32])> =
        at.channels.iter().enumerate().map(|(c, &i)| (i, planes.channel(c))).collect();
    if let (Some(alpha), Some(of_alpha)) = (alpha, layer.passes.get(&Pass::Alpha))
        && of_alpha.part == at.part
    {
        channels.push((of_alpha.channels[0], alpha.channel(0)));
    }
    frame.replace(at.part, &layer_name(&layer.name, &at.name), &channels)
}

/// Whether a pass is stored for the pixels that the beauty is stored for, which are those that are denoised.
fn has_window_of_beauty(frame: &Frame, layer: &Layer, at: &PassChannels) -> bool {
    let [own, beauty] = [at, &layer.passes[&Pass::Combined]].map(|at| frame.parts()[at.part].data_window);
    own == beauty
}

/// The full name of what is added for a pass: `ViewLayer.Denoised` for Combined, else `ViewLayer.Diffuse
/// Direct.Denoised`.
fn added_name(layer: &Layer, pass: &str, added: &str) -> String {
    match pass {
        COMBINED => layer_name(&layer.name, added),
        _ => layer_name(&layer.name, &format!("{pass}.{added}")),
    }
}

/// The full name of the layer that holds what becomes of a light pass: one that is added, or the pass itself.
fn result_name(layer: &Layer, at: &PassChannels, options: &Options) -> String {
    match &options.layer {
        Some(added) => added_name(layer, &at.name, added),
        None => layer_name(&layer.name, &at.name),
    }
}

/// The mean over stereo views of what each has, if all have it.
fn mean(of_views: impl Iterator<Item = Option<f64>>) -> Option<f64> {
    let values: Vec<f64> = of_views.collect::<Option<_>>()?;
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The name of the layer that tells how far off a result is expected to be.
fn error_layer(options: &Options) -> String {
    format!("{} Error", options.layer.as_deref().unwrap_or(COMBINED))
}

/// The path of a layer's preview: the result's, with the view where there are `views`, as `.png`.
fn preview_path(output: &Path, layer: &Layer, views: usize) -> PathBuf {
    match layer.view.as_deref().filter(|_| views > 1) {
        None => output.with_extension("png"),
        Some(view) => output.with_extension(format!("{}.png", file_name(view))),
    }
}

/// Any name as part of a file's name: characters that file systems may take for more than a letter are
/// written by their numbers, as in a URL.
fn file_name(name: &str) -> String {
    let safe = |c: char| c.is_alphanumeric() || "-_ +".contains(c);
    let write = |c: char| if safe(c) { c.into() } else { format!("%{:02X}", u32::from(c)) };
    name.chars().map(write).collect()
}

/// The headers of the EXR that exists at `output`, if there is one. Results are written whole: one of demc's that was
/// cut off, as a full disk or a failed copy leaves it, is none.
///
/// # Errors
/// The system does not let it be read, so nobody knows what would be lost.
pub(super) fn existing(output: &Path) -> Result<Option<Frame>> {
    let lost = |error: &Error| matches!(error, Error::Io { .. }) && output.exists();
    match Frame::read_headers_of_whole(output) {
        Ok(headers) => Ok(Some(headers)),
        Err(error) if lost(&error) => Err(error),
        Err(_) => Ok(Frame::read_headers(output).ok().filter(|headers| !headers.is_result())),
    }
}

/// Why a result is to be looked at that is kept although its render, or one of the frames `beside` that, has been
/// written since, as far as the disk tells.
pub(super) fn outdated<'a>(job: &Job, beside: impl IntoIterator<Item = &'a Path>) -> Option<&'static str> {
    let written = |path: &Path| path.metadata().and_then(|file| file.modified()).ok();
    let result = written(&job.output)?;
    let is_newer = |path: &Path| written(path).is_some_and(|render| render > result);
    if is_newer(&job.input) {
        return Some("is older than its render, and was kept; --overwrite denoises that again");
    }
    let why = "is older than a frame beside its render, and was kept; --overwrite makes it again";
    beside.into_iter().any(is_newer).then_some(why)
}

/// A result that is there and is the one that is wanted.
pub(super) struct Existing {
    views: Vec<Layer>,
    /// How it was made, if that is known and not how it would be made now; for the user.
    pub made_otherwise: Option<String>,
    /// The frames by number that it was made without.
    pub lacked: BTreeSet<i64>,
    /// Its expected RelMSE, as the mean over its views, where that is noted.
    pub expected_error: Option<f64>,
    /// Samples of a pixel of its render, where the file tells.
    pub samples: Option<u32>,
}

impl Existing {
    /// Looks at a file that lies where a result would be written.
    ///
    /// # Errors
    /// It is not the result that is wanted, since nothing is overwritten unasked.
    pub fn of(headers: &Frame, model: &dyn Denoiser, options: &Options) -> Result<Self> {
        let output = headers.path();
        let layers = passes::layers_by(headers, &options.sources.mapping);
        let layer = passes::choose(headers, &layers, options.view_layer.as_deref())?;
        let chosen = &layer.name;
        let beauty = layer.passes.get(&Pass::Combined).map_or(COMBINED, |at| &at.name);
        let full_name = layer_name(chosen, options.layer.as_deref().unwrap_or(beauty));
        let views = match &options.layer {
            Some(added) => passes::rgb_layers(headers, Some(chosen), added),
            // The beauty, whatever its renderer calls it.
            None => layers
                .iter()
                .filter(|l| l.name == *chosen && l.passes.contains_key(&Pass::Combined))
                .cloned()
                .collect(),
        };
        let lacks = |what: &str| {
            let why = format!(
                "exists without {what} made by demc; --overwrite denoises the frame again, or choose another --out"
            );
            Err(Error::invalid(output, why))
        };
        if views.is_empty() || !headers.is_own_layer(&full_name) {
            return lacks(&format!("'{full_name}'"));
        }
        let is_own = |at: &PassChannels| headers.is_own_layer(&result_name(layer, at, options));
        let lights = denoised_lights(layer);
        if options.passes && !lights.is_empty() && !lights.into_iter().any(is_own) {
            return lacks("denoised light passes");
        }
        if let Some(reach) = options.temporal.filter(|reach| headers.reach(&full_name) < *reach) {
            return lacks(&format!("its neighbours (--temporal {reach})"));
        }
        if options.confidence && !headers.is_own_layer(&layer_name(chosen, &error_layer(options))) {
            return lacks(&format!("'{}'", layer_name(chosen, &error_layer(options))));
        }
        let method = options.method(model);
        let made = headers.method(&full_name).filter(|made| *made != method);
        let made_otherwise = made
            .map(|made| format!("was made with {made}, and was kept; --overwrite makes it with {method}"));
        let expected = views.iter().map(|layer| headers.expected_error(&full_name, layer.view.as_deref()));
        Ok(Self {
            expected_error: mean(expected),
            samples: passes::told_samples(headers, chosen),
            lacked: headers.lacked(&full_name),
            made_otherwise,
            views,
        })
    }

    /// Writes the previews that are wanted and missing.
    ///
    /// # Errors
    /// The result cannot be read, or a preview not be written.
    pub fn write_missing_previews(&self, output: &Path, options: &Options) -> Result<()> {
        let Some(write) = options.preview else { return Ok(()) };
        let previews = self.views.iter().map(|layer| (layer, preview_path(output, layer, self.views.len())));
        let missing: Vec<_> = previews.filter(|(_, path)| !path.exists()).collect();
        if missing.is_empty() {
            return Ok(());
        }
        let frame = Frame::read(output)?;
        for (layer, path) in missing {
            let set = passes::read_layer(&frame, layer, &[Pass::Combined])?;
            write(&path, set.require(Pass::Combined, "--preview")?)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_result_without_numbers_fails_its_frame_and_single_ones_are_filled_in() {
        let result = |bad: usize| {
            let values = (0..3 * 16).map(|i| if i < bad { f32::NAN } else { 1.0 }).collect();
            let mut report = Report::default();
            let found = finite(Planes::from_vec(3, 4, 4, values), "m", Path::new("a.exr"), &mut report);
            found.map(|planes| (planes.non_finite(), report.notes.len()))
        };
        assert_eq!(result(0).unwrap(), (0, 0));
        assert_eq!(result(3).unwrap(), (0, 1));
        let error = result(25).unwrap_err().to_string();
        assert!(error.starts_with("a.exr: model m returned 25 of 48"), "{error}");
    }
}
