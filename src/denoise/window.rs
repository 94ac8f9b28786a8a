//! The frames around the one that is denoised, as far as it needs them, and what it makes of them.
//!
//! With N frames on each side, what becomes of a frame depends on the inputs of those 2N + 1 alone:
//! - its render and guides are averaged with those of the frames next to it, and the model denoises that;
//! - so are frames up to N - 1 away, and these results are averaged with its own.
//!
//! No result is made of an earlier one, so any frame can be done anywhere, in any order, to the same bits; in
//! a stream, each is read and denoised once. Both averages follow the Vector pass, and leave out what does
//! not agree: see [`agreement`](crate::filters::agreement).

use std::{
    borrow::Cow,
    collections::{BTreeMap, BTreeSet},
    time::Instant,
};

use super::{
    Alpha, Denoised, Report, Views,
    half_floats::HalfFloats,
    job::{finish, run},
    lights::Along,
};
use crate::{
    Error, Result,
    features::exposure,
    filters::{
        agreement::{self, Guides, Look},
        motion::{Direction, Flow},
        shrinkage::{self, Empty},
        structure::{self, Sight},
        temporal::{self, Link, likeness},
    },
    models::Denoiser,
    passes::{Layer, Pass, PassSet, Quantity},
    planes::{Planes, Values},
    shot::Shot,
};

/// Passes that are of use besides those of a model: motion, and what frames are told apart by.
pub const PASSES: [Pass; 6] = [
    Pass::Vector,
    Pass::DenoisingAlbedo,
    Pass::DenoisingNormal,
    Pass::Normal,
    Pass::DenoisingDepth,
    Pass::Depth,
];

/// Normals and depths, the better ones first.
const NORMALS: [Pass; 2] = [Pass::DenoisingNormal, Pass::Normal];
const DEPTHS: [Pass; 2] = [Pass::DenoisingDepth, Pass::Depth];

/// How many frames away the renders are, at most, that are averaged: of those further away, what no
/// comparison finds costs more than they bring (docs/decisions.md).
const RENDERS: usize = 1;

/// Two frames are of two shots where the mean weight of all that both show is less than this. Where they show
/// the same, it is about a half.
const CUT: f32 = 0.03;

/// Where vectors are zero everywhere and the mean weight of what has detail is less than this, things move, and
/// the vectors are missing. Of 208 pairs of frames that show the same at 4 and 16 samples, 7% have less, in fog,
/// strong blur and among stars; of 104 pairs that were shifted by three pixels, 98%.
const STILL: f32 = 0.3;

/// Exposed radiance that is dark.
const DARK: f32 = 0.02;

/// A neighbour that is more times as bright, or less than one in so many, is not averaged: not all lights of a scene
/// change by so much.
const FLASH: f32 = 1.5;

/// A neighbour is left out that is so many times as bright in a part of the frame. Of less, as of light that wanders, the
/// noise that neighbours take away is more.
const PARTLY: f32 = 1.05;

/// Name of a view layer, and the stereo view.
type ViewKey = (String, Option<String>);

/// Why a frame stays without a neighbour.
#[derive(Clone, Debug)]
enum Gap {
    /// As a sentence for the user.
    Said(String),
    /// Likewise; and the frame is not there, or cannot be used, which may change.
    Lost(i64, String),
    /// It lies beyond one of which it was said.
    Beyond,
}

/// One view of a frame.
struct Moment {
    /// All that is known of it but some passes.
    shot: Shot,
    /// These passes, which half floats hold exactly: a frame that stays alone is denoised to the same bits.
    waiting: BTreeMap<Pass, HalfFloats>,
    look: Look,
    /// What brings its render to middle grey.
    exposure: f32,
    /// What the model has to say of it.
    note: Option<String>,
    /// The part of the frame that was [rendered](PassSet::rendered).
    region: ((usize, usize), (usize, usize)),
    /// How neighbours belong together with it, by how many frames later these are.
    links: BTreeMap<i32, Result<Found, Gap>>,
    /// What the model makes of it and its neighbours' renders.
    result: Option<Planes>,
    /// What it makes of alpha, where that is denoised.
    alpha: Option<Cover>,
    /// Frames whose renders the result was made without since they were not there, or could not be used.
    lacked: BTreeSet<i64>,
}

/// Alpha of a result.
enum Cover {
    /// The same everywhere, as rendered.
    Even(f32),
    /// Denoised, (1, H, W).
    Varying(Planes),
}

/// What is kept of a [`Link`], whose flow is followed anew.
struct Found {
    weights: HalfFloats,
    brightness: f32,
    share: f32,
}

/// A frame that is averaged with another.
struct Neighbour<'a> {
    moment: &'a Moment,
    link: Link,
}

/// What training of the weights of neighbours learns from.
pub struct Candidates {
    /// The frame as rendered, (3, H, W).
    pub render: Planes,
    /// What the model makes of it and of its neighbours' renders, (3, H, W).
    pub result: Planes,
    /// Of each frame whose render and result are averaged with these.
    pub neighbours: Vec<Candidate>,
}

/// What is known of a neighbour where the content of a frame lies in it.
pub struct Candidate {
    /// 1 where that is inside of the neighbour, elsewhere 0, (1, H, W).
    pub inside: Planes,
    /// Its render there, (3, H, W), and the [features](Look::features) of every row.
    pub render: [Planes; 2],
    /// Its result there, (3, H, W), and the [features](likeness::Own::features) of every row.
    pub result: [Planes; 2],
}

/// What is in memory of a file.
struct Held {
    /// All but its passes, until it is written; none where only its neighbours are denoised.
    rest: Option<Views<()>>,
    moments: BTreeMap<ViewKey, Moment>,
    /// Why it could not be read: the error, until it is told, and its text.
    error: Option<Error>,
    trouble: Option<String>,
}

/// Frames of one sequence, by number, in memory.
pub struct Window<'a> {
    model: &'a dyn Denoiser,
    /// See [`Options::tile`](super::Options::tile).
    tile: Option<usize>,
    alpha: Alpha,
    /// How many frames away the renders are that are averaged, and the results.
    reaches: [i32; 2],
    held: BTreeMap<i64, Held>,
    /// Whether its frames are those of a stream, which are let go of in their order.
    is_stream: bool,
}

impl<'a> Window<'a> {
    /// An empty window of so many frames before and after one.
    pub fn new(reach: usize, model: &'a dyn Denoiser, (tile, alpha): (Option<usize>, Alpha)) -> Self {
        let renders = reach.min(RENDERS);
        Self {
            model,
            tile,
            alpha,
            reaches: [renders, reach - renders].map(|n| i32::try_from(n).unwrap_or(i32::MAX)),
            held: BTreeMap::new(),
            is_stream: false,
        }
    }

    /// Takes in what was read of a frame, or why it cannot be; `is_written` if it is to be denoised too.
    pub fn enter(&mut self, number: i64, loaded: Result<Views<Shot>>, is_written: bool) {
        self.is_stream = true;
        let mut moments = BTreeMap::new();
        let rest = loaded.and_then(|loaded| {
            loaded.each(|_, layer, shot, _| {
                moments.insert(key(layer), Moment::new(shot, self.model));
                Ok(())
            })
        });
        let (rest, error) = match rest {
            Ok(rest) => (is_written.then_some(rest), None),
            Err(error) => (None, Some(error)),
        };
        let trouble = error.as_ref().map(Error::to_string);
        self.held.insert(number, Held { rest, moments, error, trouble });
    }

    /// Takes in a frame that has a single view and comes from no file.
    pub fn enter_shot(&mut self, number: i64, shot: Shot) {
        let moments = BTreeMap::from([(ViewKey::default(), Moment::new(shot, self.model))]);
        self.held.insert(number, Held { rest: None, moments, error: None, trouble: None });
    }

    /// What becomes of a frame that [`Window::enter_shot`] took in.
    ///
    /// # Errors
    /// The model cannot denoise it.
    pub fn denoise_shot(&mut self, number: i64) -> Result<Planes> {
        Ok(self.view(number, &ViewKey::default(), &mut Report::default())?.0)
    }

    /// Lets go of what no frame after one needs that has been denoised, if frames come in order.
    pub fn leave(&mut self, number: i64) {
        let [renders, results] = self.reaches.map(i64::from);
        // Results that later frames may average; one that is not there yet needs the renders before it.
        let is_done = |held: &Held| held.moments.values().all(|moment| moment.result.is_some());
        let needed = (number.saturating_sub(results - 1)..=number)
            .map(|n| if self.held.get(&n).is_none_or(is_done) { n } else { n - renders })
            .chain([number.saturating_sub(renders - 1)])
            .min();
        self.held = self.held.split_off(&needed.expect("there is at least one"));
        // Of this frame the result is enough where the next one has its own already.
        if results == 1 && self.held.get(&number.saturating_add(1)).is_some_and(is_done) {
            let moments = self.held.get_mut(&number).into_iter().flat_map(|held| held.moments.values_mut());
            moments.for_each(|moment| {
                moment.keep(&[]);
                moment.links.clear();
            });
        }
    }

    /// Lets go of what a frame of a stream no longer needs, when the render of frame `averaged` has just been
    /// averaged with its neighbours': of what tells frames apart where it is known how they belong together,
    /// and of all passes but those of the result where its neighbours' renders have been averaged too.
    fn trim(&mut self, number: i64, view: &ViewKey, averaged: i64) {
        let next = |offset: i32| number + i64::from(offset);
        let is_known = |number: i64, offset: i32| {
            let knows = |moment: &Moment| moment.links.contains_key(&offset) || moment.is_result_alone();
            self.moment(number, view).is_none_or(knows)
        };
        let is_linked = offsets(1).all(|n| is_known(number, n) && is_known(next(n), -n));
        // Results of frames further away are linked later.
        if !self.is_stream || self.reaches[1] > 1 || !is_linked {
            return;
        }
        let is_averaged = (-1..=1).map(next).all(|number| {
            number == averaged || self.moment(number, view).is_none_or(|moment| moment.result.is_some())
        });
        let mut kept = vec![Pass::Combined, Pass::Alpha, Pass::Vector];
        if !is_averaged {
            kept.extend(self.model.passes().iter().chain(self.model.optional_passes()));
        }
        if let Some(moment) = self.moment_mut(number, view) {
            moment.keep(&kept);
        }
    }

    /// Denoises a frame that has entered to be written, as all that lies around it has.
    ///
    /// # Errors
    /// It could not be read, or the model cannot denoise it.
    pub fn denoise(&mut self, number: i64) -> Result<Views<Denoised>> {
        let held = self.held.get_mut(&number).expect("a frame enters before it is denoised");
        if let Some(error) = held.error.take() {
            return Err(error);
        }
        let rest = held.rest.take().expect("it is denoised once");
        rest.each(|_, layer, (), report| {
            let start = Instant::now();
            let (radiance, alpha) = self.view(number, &key(layer), report)?;
            report.seconds = start.elapsed().as_secs_f64();
            let own = self.moment(number, &key(layer)).expect("its views have entered");
            let alpha = alpha.or_else(|| own.pass(Pass::Alpha).map(Cow::into_owned));
            finish(&own.shot.passes.path, radiance, (alpha, Vec::new()), self.model, report)
        })
    }

    /// See [`super::Temporal::candidates`], of a frame that [`Window::enter_shot`] took in.
    ///
    /// # Errors
    /// The model cannot denoise a frame.
    pub fn candidates(&mut self, number: i64) -> Result<Candidates> {
        let view = ViewKey::default();
        self.gather(number, &view, &mut Report::default())?;
        let own = self.moment(number, &view).expect("it has entered");
        let (result, render) = (own.result(), own.render());
        let likeness = likeness::Own::of(result, &render, own.exposure);
        let neighbours = self.neighbours(number, &view, self.reaches[1]).map(|Neighbour { moment, link }| {
            let (guides, there) = (own.guides(), moment.guides());
            let features = own.look.features(&moment.look, &link.flow, link.brightness, &guides, &there);
            Candidate {
                inside: link.inside(),
                render: [link.nearest(&moment.render()), features],
                result: likeness.features(moment.result(), &link).into(),
            }
        });
        Ok(Candidates {
            neighbours: neighbours.collect(),
            render: render.clone().into_owned(),
            result: result.clone(),
        })
    }

    /// Radiance, and alpha where it was denoised.
    fn view(&mut self, number: i64, view: &ViewKey, report: &mut Report) -> Result<(Planes, Option<Planes>)> {
        self.gather(number, view, report)?;
        let own = self.moment(number, view).expect("its views have entered");
        let radiance = own.render();
        let others: Vec<Neighbour> = self.neighbours(number, view, self.reaches[1]).collect();
        let mut moments = others.iter().map(|other| other.moment).chain([own]);
        let has_alpha = moments.any(|moment| matches!(moment.alpha, Some(Cover::Varying(_))));
        let results: Vec<Cow<Planes>> =
            others.iter().map(|other| other.moment.result_with(has_alpha)).collect();
        let neighbours: Vec<(&Planes, &Link)> =
            results.iter().zip(&others).map(|(result, other)| (&**result, &other.link)).collect();
        let blended = temporal::blend(&own.result_with(has_alpha), &radiance, own.exposure, &neighbours);
        let blended = own.inside(blended);
        let (mut blended, mut alpha) = match has_alpha {
            true => {
                let [light, mut alpha] = blended.split_after(3);
                alpha.data.iter_mut().for_each(|share| *share = share.clamp(0.0, 1.0));
                (light, Some(alpha))
            }
            false => (blended, None),
        };
        if let Some(rendered) = own.pass(Pass::Alpha) {
            let both = shrinkage::Alpha { rendered: &rendered, denoised: alpha.as_ref() };
            if let Some(empty) = Empty::of(&radiance, both, own.shot.passes.samples) {
                empty.clear(&mut blended);
                alpha.iter_mut().for_each(|alpha| empty.clear(alpha));
            }
        }
        Ok((blended, alpha))
    }

    /// Finds the neighbours of a frame, and runs the model over it and over those whose results are averaged.
    fn gather(&mut self, number: i64, view: &ViewKey, report: &mut Report) -> Result<()> {
        let [renders, results] = self.reaches;
        for offset in offsets(renders.max(results)) {
            self.connect(number, view, offset);
        }
        self.explain(number, view, report);
        let of_model = self.moment(number, view).and_then(|own| own.note.clone());
        report.notes.extend(of_model.filter(|note| !report.notes.contains(note)));
        self.infer(number, view)?;
        report.lacked.extend(self.lost(number, view, renders.max(results)));
        for offset in offsets(results) {
            if self.is_linked(number, view, offset) {
                let other = number + i64::from(offset);
                self.infer(other, view)?;
                report.lacked.extend(&self.moment(other, view).expect("it was inferred").lacked);
            }
        }
        Ok(())
    }

    /// The frames up to so many away that are not there, or cannot be used.
    fn lost(&self, number: i64, view: &ViewKey, reach: i32) -> BTreeSet<i64> {
        let links = offsets(reach).filter_map(|offset| self.moment(number, view)?.links.get(&offset));
        links
            .filter_map(|link| if let Err(Gap::Lost(frame, _)) = link { Some(*frame) } else { None })
            .collect()
    }

    /// The frames up to so many away that a frame is averaged with.
    fn neighbours(&self, number: i64, view: &ViewKey, reach: i32) -> impl Iterator<Item = Neighbour<'_>> {
        offsets(reach).filter_map(move |offset| {
            let own = self.moment(number, view)?;
            let Found { weights, brightness, share } = own.links.get(&offset)?.as_ref().ok()?;
            let flow = self.flow(number, view, offset).ok()?;
            let moment = self.moment(number + i64::from(offset), view)?;
            let link = Link { flow, weights: weights.planes(), brightness: *brightness, share: *share };
            Some(Neighbour { moment, link })
        })
    }

    /// Where the content of a frame lies in one so many frames later; the number of the frame whose vectors
    /// are missing, if some are.
    fn flow(&self, number: i64, view: &ViewKey, offset: i32) -> Result<Flow, i64> {
        let (step, direction) = step(offset);
        let own = &self.moment(number, view).ok_or(number)?.shot.passes;
        let mut flow = Flow::still(own.width, own.height);
        for nearer in 0..offset.abs() {
            let at = number + i64::from(step * nearer);
            let vectors = self.moment(at, view).and_then(|moment| moment.pass(Pass::Vector)).ok_or(at)?;
            flow.step(&vectors, direction);
        }
        Ok(flow)
    }

    /// Runs the model over a frame's render, averaged with its neighbours', unless that was done.
    fn infer(&mut self, number: i64, view: &ViewKey) -> Result<()> {
        let Self { model, tile, alpha, reaches: [renders, _], .. } = *self;
        if self.moment(number, view).is_some_and(|own| own.result.is_some()) {
            return Ok(());
        }
        for offset in offsets(renders) {
            self.connect(number, view, offset);
            // What will be asked of a frame of a stream is found out now, so that less of it is held.
            if self.is_stream {
                self.connect(number + i64::from(offset), view, -offset);
            }
        }
        let own = self.moment(number, view).expect("only frames that are there are inferred");
        // Half buffers are the frame's own: a model that holds them against each other reads no average
        // beside them.
        let is_linked = offsets(renders).any(|offset| self.is_linked(number, view, offset));
        let mut shot = if is_linked && !model.reads_halves() {
            let others: Vec<Neighbour> = self.neighbours(number, view, renders).collect();
            let mut average = Shot::new(average(own, &others, model));
            average.wraps = own.shot.wraps;
            average
        } else {
            own.shot()
        };
        offsets(renders).chain([0]).for_each(|n| self.trim(number + i64::from(n), view, number));
        let mut along = Along::of_alpha(&mut shot, model, alpha);
        let even = shot.passes.get(Pass::Alpha).filter(|rendered| alpha != Alpha::Keep && !rendered.varies());
        let even = even.and_then(|rendered| rendered.data.first().copied());
        let (image, _) = run(&shot, &mut along.companions, false, (model, tile))?;
        along.denoise_apart(shot, (model, tile))?;
        let lacked = self.lost(number, view, renders);
        let moment = self.moment_mut(number, view).expect("it is there");
        moment.alpha = along.alpha().map(Cover::Varying).or(even.map(Cover::Even));
        (moment.result, moment.lacked) = (Some(image), lacked);
        Ok(())
    }

    /// Finds out how a frame and one of its neighbours belong together, unless that is known.
    fn connect(&mut self, number: i64, view: &ViewKey, offset: i32) {
        let is_known = self.moment(number, view).is_none_or(|moment| moment.links.contains_key(&offset));
        if is_known {
            return;
        }
        let link = self.find_link(number, view, offset);
        if let Some(moment) = self.moment_mut(number, view) {
            moment.links.insert(offset, link);
        }
    }

    /// How a neighbour belongs together with a frame.
    fn find_link(&mut self, number: i64, view: &ViewKey, offset: i32) -> Result<Found, Gap> {
        let (step, _) = step(offset);
        // What lies further away is reached through what lies nearer.
        for nearer in 0..offset.abs() - 1 {
            let from = number + i64::from(step * nearer);
            self.connect(from, view, step);
            if !self.is_linked(from, view, step) {
                return Err(Gap::Beyond);
            }
        }
        let said = |text: String| Err(Gap::Said(text));
        let there = number + i64::from(offset);
        let own = self.moment(number, view).expect("links begin at frames that are there");
        let lost = |why: String| Err(Gap::Lost(there, format!("frame {there} {why}")));
        let Some(held) = self.held.get(&there) else { return lost("is not there".into()) };
        if let Some(trouble) = &held.trouble {
            return lost(format!("cannot be used ({trouble})"));
        }
        let Some(other) = held.moments.get(view) else {
            let (layer, _) = view;
            return said(format!(
                "frame {there} has not this view layer and view, or another was chosen of it (--view-layer '{layer}' takes \
                 this one of all)"
            ));
        };
        let place = |set: &PassSet| (set.width, set.height, set.origin);
        if place(&own.shot.passes) != place(&other.shot.passes) {
            return said(format!("frame {there} is of another size or region"));
        }
        let flow = match self.flow(number, view, offset) {
            Ok(flow) => flow,
            Err(at) => {
                let renderer = own.shot.passes.renderer;
                return said(match renderer.is_blender() {
                    true => format!(
                        "frame {at} has no pass Vector; {}, and Render Properties > Motion Blur off",
                        renderer.setting(Pass::Vector)
                    ),
                    false => format!(
                        "frame {at} has no Vector of Cycles', and {}'s motion is not followed",
                        renderer.name
                    ),
                });
            }
        };
        let held = |moment: &Moment| {
            let Guides { albedo, normal, depth } = moment.guides();
            [albedo, normal, depth, moment.values(Pass::Alpha)].map(|pass| pass.is_some())
        };
        if held(own) != held(other) {
            return said(format!(
                "frame {there} holds other passes: albedo, normal, depth or alpha is missing in one of them"
            ));
        }
        let are_zero = |nearer: i32| {
            let moment = self.moment(number + i64::from(step * nearer), view);
            let vectors = moment.and_then(|moment| moment.pass(Pass::Vector));
            vectors.is_none_or(|vectors| vectors.data.iter().all(|v| *v == 0.0))
        };
        own.judge(other, there, &flow, || (0..offset.abs()).all(are_zero))
    }

    /// Says what a frame stays without, where its window is not full.
    fn explain(&self, number: i64, view: &ViewKey, report: &mut Report) {
        let Some(moment) = self.moment(number, view) else { return };
        let gaps = moment.links.values().filter_map(|link| match link {
            Err(Gap::Said(text) | Gap::Lost(_, text)) => Some(text.as_str()),
            _ => None,
        });
        let mut gaps: Vec<&str> = gaps.collect();
        gaps.dedup();
        if gaps.is_empty() {
            return;
        }
        let is_alone = moment.links.values().all(Result::is_err);
        let end = if is_alone { "denoised alone" } else { "denoised with those that are left" };
        let note = format!("{}; {end}", gaps.join("; "));
        if !report.notes.contains(&note) {
            report.notes.push(note);
        }
    }

    fn is_linked(&self, number: i64, view: &ViewKey, offset: i32) -> bool {
        let link = self.moment(number, view).and_then(|moment| moment.links.get(&offset));
        link.is_some_and(Result::is_ok)
    }

    fn moment(&self, number: i64, view: &ViewKey) -> Option<&Moment> {
        self.held.get(&number)?.moments.get(view)
    }

    fn moment_mut(&mut self, number: i64, view: &ViewKey) -> Option<&mut Moment> {
        self.held.get_mut(&number)?.moments.get_mut(view)
    }
}

impl Moment {
    fn new(mut shot: Shot, model: &dyn Denoiser) -> Self {
        let (region, note) = (shot.passes.rendered(), model.notes(&shot));
        let passes = &mut shot.passes;
        // Of two passes that tell the same, the first is enough.
        for [first, second] in [NORMALS, DEPTHS] {
            let is_read = [model.passes(), model.optional_passes()].concat().contains(&second);
            if passes.get(first).is_some() && !is_read {
                drop(passes.remove(second));
            }
        }
        let radiance = passes.get(Pass::Combined).expect("a frame is not loaded without it");
        let look = Look::of(radiance, &guides(|pass| Some(passes.get(pass)?)));
        let exposure = exposure(radiance);
        let averaged = Pass::ALL.into_iter().filter(|pass| !is_place(*pass));
        let waiting = averaged.filter_map(|pass| {
            let halves = HalfFloats::exactly(passes.get(pass)?)?;
            drop(passes.remove(pass));
            Some((pass, halves))
        });
        let waiting = waiting.collect();
        Self {
            shot,
            waiting,
            look,
            exposure,
            note,
            region,
            links: BTreeMap::new(),
            result: None,
            alpha: None,
            lacked: BTreeSet::new(),
        }
    }

    /// How frame `there` belongs together with this one, whose content lies in it where `flow` says; whether it stands
    /// `still` by all vectors is asked where that matters.
    fn judge(&self, other: &Self, there: i64, flow: &Flow, still: impl Fn() -> bool) -> Result<Found, Gap> {
        let said = |text: String| Err(Gap::Said(text));
        if self.is_copy_of(other) && !still() {
            return said(format!(
                "frame {there} holds the same picture to the bit, though Vector tells of motion"
            ));
        }
        // Of fewer samples, light has more of an excess in few pixels, and looks darker where most are.
        let [samples, others] = [self, other].map(|moment| moment.shot.passes.samples);
        let has_as_many = samples == others;
        let found = has_as_many.then(|| self.look.brightness(&other.look, flow));
        let brightness = found.filter(|found| found.is_everywhere).map_or(1.0, |found| found.times);
        let mut weights = self.look.agreement(&other.look, flow, brightness, &self.guides(), &other.guides());
        if let [Some(light), Some(there)] = [self, other].map(|moment| moment.values(Pass::Combined)) {
            agreement::dim(&mut weights, flow, light, there, DARK / self.exposure);
        }
        let (mut sum, mut inside) = (0.0, 0usize);
        for y in 0..weights.height {
            sum += weights.row(0, y).iter().map(|w| f64::from(*w)).sum::<f64>();
            inside += flow.row(y).0.iter().filter(|x| !x.is_nan()).count();
        }
        let share = (sum / inside.max(1) as f64) as f32;
        // A sky before which the camera moves looks the same; what has edges tells.
        let of_detail = self.look.mean_at_detail(&weights).unwrap_or(share);
        if !has_as_many && (of_detail < STILL || share < CUT) {
            return said(format!(
                "frame {there} shows another picture (a cut), or one that its other number of samples lets not compare"
            ));
        }
        if of_detail < STILL && self.has_other_guides(other) && still() {
            return said(format!(
                "frame {there} shows another picture, and Vector is zero everywhere: a cut, or motion blur was on, with \
                 which Blender writes no vectors (turn off Render Properties > Motion Blur and blur in the compositor, \
                 or denoise frame by frame)"
            ));
        }
        if share < CUT {
            return said(format!("frame {there} shows another picture: a cut"));
        }
        if !(1.0 / FLASH..FLASH).contains(&brightness) {
            let times = 1.0 / brightness;
            return said(format!(
                "frame {there} is {times:.2} times as bright, and its noise is that of other light"
            ));
        }
        // What is lit as before would change with the rest of the frame, or the rest stay behind.
        if let Some(found) = found
            && !found.is_everywhere
            && !(1.0 / PARTLY..PARTLY).contains(&found.times)
        {
            let times = 1.0 / found.times;
            return said(format!("frame {there} is {times:.2} times as bright in a part of what it shows"));
        }
        // The noise of fewer samples would make a frame worse.
        let share = match (samples, others) {
            (Some(own), Some(there)) if there < own => there as f32 / own as f32,
            _ => 1.0,
        };
        if let [Some(own), Some(there)] = [self, other].map(Self::sight) {
            structure::lower(&mut weights, flow, [own, there], brightness, samples);
        }
        Ok(Found { weights: HalfFloats::of(&weights), brightness, share })
    }

    fn sight(&self) -> Option<Sight<'_>> {
        Some(Sight { light: self.values(Pass::Combined)?, albedo: self.guides().albedo })
    }

    /// Whether another frame's light is this one's to the bit. Of black frames there is nothing to tell.
    fn is_copy_of(&self, other: &Self) -> bool {
        let [Some(own), Some(there)] = [self, other].map(|moment| moment.values(Pass::Combined)) else {
            return false;
        };
        let (channels, width, height) = own.extent();
        let (mut lines, mut is_black) = ([vec![0.0; width], vec![0.0; width]], true);
        let is_same = (0..channels * height).all(|row| {
            let (c, y) = (row / height, row % height);
            lines.iter_mut().zip([own, there]).for_each(|(line, of)| of.read(c, y * width, line));
            is_black &= lines[0].iter().all(|v| *v == 0.0);
            lines[0] == lines[1]
        });
        is_same && !is_black
    }

    /// Whether another frame shows other guides at the same places; true of frames that have none.
    fn has_other_guides(&self, other: &Self) -> bool {
        let Guides { albedo, normal, depth } = self.guides();
        let has_none = albedo.is_none() && normal.is_none() && depth.is_none();
        has_none || self.look.has_other_guides(&other.look)
    }

    fn values(&self, pass: Pass) -> Option<&dyn Values> {
        let waiting = || Some(self.waiting.get(&pass)? as &dyn Values);
        self.shot.passes.get(pass).map(|planes| planes as &dyn Values).or_else(waiting)
    }

    fn pass(&self, pass: Pass) -> Option<Cow<'_, Planes>> {
        let waiting = || Some(Cow::Owned(self.waiting.get(&pass)?.planes()));
        self.shot.passes.get(pass).map(Cow::Borrowed).or_else(waiting)
    }

    /// The frame as rendered.
    fn render(&self) -> Cow<'_, Planes> {
        self.pass(Pass::Combined).expect("it is kept for as long as it is needed")
    }

    fn guides(&self) -> Guides<'_> {
        guides(|pass| self.values(pass))
    }

    /// What the model made of it.
    fn result(&self) -> &Planes {
        self.result.as_ref().expect("the model ran over it")
    }

    /// Likewise, with alpha as a fourth plane if that is wanted.
    fn result_with(&self, alpha: bool) -> Cow<'_, Planes> {
        let result = self.result();
        match &self.alpha {
            _ if !alpha => Cow::Borrowed(result),
            Some(Cover::Varying(alpha)) => Cow::Owned(result.followed_by(alpha)),
            Some(Cover::Even(share)) => {
                let mut even = Planes::unwritten(1, result.width, result.height);
                even.data.fill(*share);
                Cow::Owned(result.followed_by(&even))
            }
            None => unreachable!("frames with alpha and without are not averaged"),
        }
    }

    /// With all its passes.
    fn shot(&self) -> Shot {
        let mut shot = self.shot.clone();
        self.waiting.iter().for_each(|(pass, planes)| shot.passes.insert(*pass, planes.planes()));
        shot
    }

    /// Planes of the frame, which are zero outside of what was rendered: a neighbour may have been rendered there.
    fn inside(&self, planes: Planes) -> Planes {
        let (whole, (place, size)) = ((planes.width, planes.height), self.region);
        if size == whole { planes } else { planes.window(place, size).placed_in(whole, place) }
    }

    /// Whether all else was let go of.
    fn is_result_alone(&self) -> bool {
        self.values(Pass::Combined).is_none()
    }

    /// Lets go of what tells frames apart, and of all passes but some.
    fn keep(&mut self, passes: &[Pass]) {
        self.look = Look::default();
        self.waiting.retain(|pass, _| passes.contains(pass));
        for pass in Pass::ALL.into_iter().filter(|pass| !passes.contains(pass)) {
            drop(self.shot.passes.remove(pass));
        }
    }
}

/// Whether a pass tells where a pixel's content lies: it is never averaged.
fn is_place(pass: Pass) -> bool {
    matches!(pass.quantity(), Quantity::Place | Quantity::Distance)
}

/// What tells, besides light, whether two frames show the same.
fn guides<'a>(pass: impl Fn(Pass) -> Option<&'a dyn Values>) -> Guides<'a> {
    let either = |[first, second]: [Pass; 2]| pass(first).or_else(|| pass(second));
    Guides { albedo: pass(Pass::DenoisingAlbedo), normal: either(NORMALS), depth: either(DEPTHS) }
}

/// How many frames later the first step is on the way to a neighbour, and its direction.
fn step(offset: i32) -> (i32, Direction) {
    if offset < 0 { (-1, Direction::Back) } else { (1, Direction::Forth) }
}

fn key(layer: &Layer) -> ViewKey {
    (layer.name.clone(), layer.view.clone())
}

/// How many frames later neighbours are, nearest first.
fn offsets(reach: i32) -> impl Iterator<Item = i32> {
    (1..=reach).flat_map(|n| [-n, n])
}

/// The passes of a frame that the model reads, and alpha, averaged with those of its neighbours. Places remain its own.
fn average(own: &Moment, others: &[Neighbour<'_>], model: &dyn Denoiser) -> PassSet {
    let passes = &own.shot.passes;
    // With as many samples as the frame alone: fireflies are spread over more pixels, but not rarer. Told that there are
    // more samples, the shrinkage would take them for detail.
    let mut set = passes.empty((passes.width, passes.height));
    for &pass in model.passes().iter().chain(model.optional_passes()).chain(&[Pass::Alpha]) {
        let Some(values) = own.values(pass) else { continue };
        if is_place(pass) {
            // Places never wait.
            passes.get(pass).into_iter().for_each(|planes| set.insert(pass, planes.clone()));
        } else {
            let of_others: Vec<(&dyn Values, &Link)> =
                others.iter().filter_map(|other| Some((other.moment.values(pass)?, &other.link))).collect();
            let is_light = pass.carries_radiance();
            set.insert(pass, own.inside(temporal::merge(values, is_light, &of_others)));
        }
    }
    set.origin = passes.origin;
    set
}
